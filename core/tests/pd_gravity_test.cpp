// PD + feed-forward: the law, its saturation, and what it does when a number is missing.
#include "palpate/control/pd_gravity.hpp"

#include <gtest/gtest.h>

#include <limits>
#include <string>
#include <vector>

#include "no_alloc.hpp"

using namespace palpate;

namespace {

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double inf = std::numeric_limits<double>::infinity();
constexpr int n = 2;

PdGains gains() { return {.kp = {5.0, 2.5}, .kd = {3.5, 1.0}, .limit = {2.5, 2.5}}; }
const JointVector q{0.1, -0.2}, dq{0.3, 0.1}, gravity{0.4, -0.5};
Setpoint wanted() {
  Setpoint s;
  s.q = {0.2, -0.1};
  s.dq = {0.1, 0.1};
  return s;
}

TEST(PdGravity, IsTheLaw) {
  PdGravity pd(n, gains());
  const JointCommand u = pd.step(wanted(), q, dq, gravity, 42);
  EXPECT_NEAR(u.torque[0], 0.4 + 5.0 * 0.1 + 3.5 * -0.2, 1e-15);
  EXPECT_NEAR(u.torque[1], -0.5 + 2.5 * 0.1, 1e-15);
  EXPECT_EQ(u.torque[2], 0.0);
  EXPECT_EQ(u.status, Status::ok);
  EXPECT_EQ(u.time_ns, 42);
}

TEST(PdGravity, ZeroInZeroOut) {
  PdGravity pd(n, gains());
  EXPECT_EQ(pd.step({}, {}, {}, {}).torque, JointVector{});
}

TEST(PdGravity, HoldsALoadedJointAtTheGoalWithoutError) {
  // one joint, I q'' = u - m g l sin q: PD + gravity of the state settles at the goal exactly (MATH.md section 8)
  PdGravity pd(1, {.kp = {20.0}, .kd = {4.0}, .limit = {inf}});
  const double inertia = 0.2, mgl = 3.0, dt = 0.001;
  Setpoint goal;
  goal.q[0] = 0.7;
  JointVector x{}, v{};
  for (int k = 0; k < 10000; ++k) {
    const double u = pd.step(goal, x, v, {mgl * std::sin(x[0])}).torque[0];
    v[0] += dt * (u - mgl * std::sin(x[0])) / inertia;
    x[0] += dt * v[0];
  }
  EXPECT_NEAR(x[0], 0.7, 1e-12);
}

TEST(PdGravity, ClipsEachJointAndSaysSo) {
  PdGravity pd(n, gains());
  Setpoint far = wanted();
  far.q[1] = -100.0;
  const JointCommand u = pd.step(far, q, dq, gravity);
  EXPECT_NEAR(u.torque[0], 0.2, 1e-15);
  EXPECT_EQ(u.torque[1], -2.5);
  EXPECT_EQ(u.status, Status::saturated);
  EXPECT_EQ(pd.step(wanted(), q, dq, gravity).status, Status::ok);
}

TEST(PdGravity, WithoutAStateTheFeedForwardRemains) {
  PdGravity pd(n, gains());
  (void)pd.step(wanted(), q, dq, {1.0, 1.0});
  for (double junk : {nan, inf, -inf}) {
    Setpoint s = wanted();
    s.dq[1] = junk;
    for (const JointCommand& u :
         {pd.step(s, q, dq, gravity), pd.step(wanted(), {junk}, dq, gravity), pd.step(wanted(), q, {0.0, junk}, gravity)}) {
      EXPECT_EQ(u.status, Status::non_finite);
      EXPECT_EQ(u.torque, gravity);  // all joints: no half-informed feedback
    }
  }
}

TEST(PdGravity, WithoutAFeedForwardTheLastOneIsRepeated) {
  PdGravity pd(n, gains());
  EXPECT_EQ(pd.step(wanted(), q, dq, {nan, 0.0}).torque, JointVector{});  // there was none yet
  (void)pd.step(wanted(), q, dq, gravity);
  for (int k = 0; k < 3; ++k) {
    const JointCommand u = pd.step(wanted(), {nan}, dq, {0.0, inf});
    EXPECT_EQ(u.status, Status::non_finite);
    EXPECT_EQ(u.torque, gravity);  // not the last command, which held a push
  }
  (void)pd.step(wanted(), {nan}, dq, {9.0, 0.25});  // a good feed-forward beside a bad state is remembered too
  const JointCommand clipped = pd.step(wanted(), q, dq, {nan});
  EXPECT_EQ(clipped.torque, (JointVector{2.5, 0.25}));
  EXPECT_EQ(clipped.status, Status::non_finite);  // worse than saturated
}

TEST(PdGravity, FeedbackThatOverflowsIsNotUsed) {
  PdGravity pd(n, {.kp = {1e200, 0.0}, .kd = {1e200, 0.0}, .limit = {5.0, 5.0}});
  Setpoint s;
  s.q[0] = 1e200;
  s.dq[0] = -1e200;  // inf - inf
  const JointCommand u = pd.step(s, {}, {}, gravity);
  EXPECT_EQ(u.status, Status::non_finite);
  EXPECT_EQ(u.torque, gravity);
}

TEST(PdGravity, ChunkedRunIsWholeRunAndResetIsNew) {
  PdGravity whole(n, gains()), chunk(n, gains());
  (void)chunk.step(wanted(), q, dq, {1.5, 1.5});
  chunk.reset();
  for (int k = 0; k < 100; ++k) {
    JointVector ff = gravity;
    if (k % 9 == 0) ff[0] = nan;
    ff[1] += 0.01 * k;
    if (k == 50) chunk = PdGravity(chunk);
    EXPECT_EQ(chunk.step(wanted(), q, dq, ff).torque, whole.step(wanted(), q, dq, ff).torque);
  }
}

TEST(PdGravity, AllocatesNothing) {
  PdGravity pd(n, gains());
  palpate::test::AllocationCounter counter;
  for (int k = 0; k < 100; ++k) (void)pd.step(wanted(), q, dq, k % 3 == 0 ? JointVector{nan} : gravity);
  EXPECT_EQ(counter.count(), 0u);
}

TEST(PdGravity, ConstructorNamesWhatIsWrong) {
  const auto message = [](auto make) -> std::string {
    try {
      make();
    } catch (const std::invalid_argument& e) {
      return e.what();
    }
    return "nothing thrown";
  };
  EXPECT_EQ(message([] { PdGravity(17, gains()); }), "PdGravity n = 17: expected an integer from 1 to 16");
  EXPECT_EQ(message([] { PdGravity(3, gains()); }), "PdGains limit[2] [N m] = 0: expected a number > 0, or infinity for no limit");
  EXPECT_EQ(message([] { PdGravity(1, {.kp = {-1.0}, .limit = {1.0}}); }), "PdGains kp[0] [N m/rad] = -1: expected a finite number >= 0");
  EXPECT_EQ(message([] { PdGravity(1, {.kd = {nan}, .limit = {1.0}}); }), "PdGains kd[0] [N m s/rad] = nan: expected a finite number >= 0");
}

}  // namespace
