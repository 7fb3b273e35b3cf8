// Trajectories: closed forms, boundary conditions, limits kept and reached.
#include "palpate/trajectory.hpp"

#include <gtest/gtest.h>

#include <limits>
#include <string>

#include "no_alloc.hpp"

using namespace palpate;

namespace {

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double inf = std::numeric_limits<double>::infinity();
constexpr int n = 7;
const JointVector zero{};
const JointVector goal{0.5, -0.1, 1.0, 1.1, 0.0, 0.7, -0.4};  // the mass-estimation report's experiment

TEST(Quintic, AgreesWithThePolynomialOfTheBoundaryConditions) {
  // numpy.linalg.solve of q(0)=0 q'(0)=0 q''(0)=0 q(3)=1.1 q'(3)=0 q''(3)=0, then numpy.polyval at t
  struct Row {
    double t, q, dq, ddq;
  };
  const Quintic motion(n, zero, goal, 3.0);
  for (const Row& r : {Row{0.3, 0.009416, 0.0891, 0.528}, Row{0.9, 0.179388, 0.4851, 0.616}, Row{1.5, 0.55, 0.6875, 0.0},
                       Row{2.4, 1.036288, 0.2816, -0.704}, Row{2.9, 1.0996126913580282, 0.011420987654318537, -0.22054320987654386}}) {
    const Setpoint p = motion.sample(r.t);
    EXPECT_NEAR(p.q[3], r.q, 1e-14) << r.t;
    EXPECT_NEAR(p.dq[3], r.dq, 1e-14) << r.t;
    EXPECT_NEAR(p.ddq[3], r.ddq, 1e-13) << r.t;
  }
}

TEST(Quintic, StandsExactlyAtBothEnds) {
  const Quintic motion(n, {0.3, -0.2}, goal, 3.0);
  for (double t : {-inf, -1.0, 0.0, nan}) {
    EXPECT_EQ(motion.sample(t).q, (JointVector{0.3, -0.2}));
    EXPECT_EQ(motion.sample(t).dq, zero);
    EXPECT_EQ(motion.sample(t).ddq, zero);
  }
  for (double t : {3.0, 3.5, inf}) {
    EXPECT_EQ(motion.sample(t).q, goal);
    EXPECT_EQ(motion.sample(t).dq, zero);
    EXPECT_EQ(motion.sample(t).ddq, zero);
  }
  const Setpoint almost = motion.sample(std::nextafter(3.0, 0.0));
  for (std::size_t j = 0; j < n; ++j) {
    EXPECT_EQ(almost.q[j], goal[j]);
    EXPECT_NEAR(almost.dq[j], 0.0, 1e-14);
    EXPECT_NEAR(almost.ddq[j], 0.0, 1e-14);
  }
}

TEST(Quintic, VelocityAndAccelerationAreTheDerivatives) {
  const Quintic motion(n, {1.0, 1.0, 1.0}, goal, 2.0);
  const double h = 1e-5;
  for (double t = 0.1; t < 1.95; t += 0.05) {
    const Setpoint p = motion.sample(t), a = motion.sample(t - h), b = motion.sample(t + h);
    for (std::size_t j = 0; j < n; ++j) {
      EXPECT_NEAR(p.dq[j], (b.q[j] - a.q[j]) / (2 * h), 1e-9);
      EXPECT_NEAR(p.ddq[j], (b.dq[j] - a.dq[j]) / (2 * h), 1e-8);
    }
  }
}

TEST(Quintic, KeepsItsLimitsAndReachesOne) {
  const JointVector slow{1.0, 1.0, 0.2, 1.0, inf, 1.0, 1.0};
  JointVector none, gentle;
  none.fill(inf);
  gentle.fill(0.8);
  const auto peaks = [](const Quintic& motion) {
    std::array<double, 2> worst{};  // of |dq_2|, |ddq_3|
    for (int k = 0; k <= 100000; ++k) {
      const Setpoint p = motion.sample(motion.duration() * k / 100000);
      worst[0] = std::max(worst[0], std::abs(p.dq[2]));
      worst[1] = std::max(worst[1], std::abs(p.ddq[3]));
    }
    return worst;
  };
  const Quintic by_speed = Quintic::within_limits(n, zero, goal, slow, none);
  EXPECT_DOUBLE_EQ(by_speed.duration(), 1.875 * 1.0 / 0.2);
  EXPECT_NEAR(peaks(by_speed)[0], 0.2, 1e-12);

  const Quintic by_acceleration = Quintic::within_limits(n, zero, goal, none, gentle);
  EXPECT_NEAR(by_acceleration.duration(), std::sqrt(10.0 / std::sqrt(3.0) * 1.1 / 0.8), 1e-12);
  EXPECT_NEAR(peaks(by_acceleration)[1], 0.8, 1e-8);

  EXPECT_DOUBLE_EQ(Quintic::within_limits(n, zero, goal, 0.5).duration(), 1.875 * 1.1 / 0.5);
}

TEST(Quintic, GoalEqualToStartIsNoMotionNotAnError) {
  const Quintic by_time(n, goal, goal, 0.0);
  const Quintic by_speed = Quintic::within_limits(n, goal, goal, 0.5);
  for (const Quintic& motion : {by_time, by_speed}) {
    EXPECT_EQ(motion.duration(), 0.0);
    for (double t : {-1.0, 0.0, 1.0}) {
      EXPECT_EQ(motion.sample(t).q, goal);
      EXPECT_EQ(motion.sample(t).dq, zero);
      EXPECT_EQ(motion.sample(t).ddq, zero);
    }
  }
  const Quintic waits(n, goal, goal, 2.0);
  EXPECT_EQ(waits.duration(), 2.0);
  EXPECT_EQ(waits.sample(1.0).q, goal);
}

TEST(Schedule, RunsItsPartsInOrder) {
  Schedule s(n, zero);
  s.move_in(goal, 2.0).dwell(1.0).move_in(zero, 4.0).dwell(0.25).dwell(0.25);
  EXPECT_EQ(s.size(), 2);
  EXPECT_DOUBLE_EQ(s.duration(), 7.5);
  const Quintic there(n, zero, goal, 2.0), back(n, goal, zero, 4.0);
  EXPECT_EQ(s.sample(-1.0).q, zero);
  EXPECT_EQ(s.sample(1.2).q, there.sample(1.2).q);
  EXPECT_EQ(s.sample(2.5).q, goal);
  EXPECT_EQ(s.sample(2.5).dq, zero);
  EXPECT_EQ(s.sample(4.0).dq, back.sample(1.0).dq);
  EXPECT_EQ(s.sample(7.2).q, zero);
  EXPECT_EQ(s.sample(1e9).q, zero);

  EXPECT_EQ(s.phase(-1.0).index, 0);
  EXPECT_TRUE(s.phase(nan).moving);
  EXPECT_TRUE(s.phase(1.2).moving);
  EXPECT_DOUBLE_EQ(s.phase(1.2).elapsed, 1.2);
  EXPECT_FALSE(s.phase(2.5).moving);
  EXPECT_DOUBLE_EQ(s.phase(2.5).elapsed, 0.5);
  EXPECT_EQ(s.phase(3.0).index, 1);
  EXPECT_TRUE(s.phase(3.0).moving);
  EXPECT_FALSE(s.phase(7.2).finished);
  EXPECT_TRUE(s.phase(7.5).finished);
}

TEST(Schedule, IsContinuous) {
  Schedule s(n, zero);
  s.dwell(0.5).move_to(goal, 0.5).dwell(0.3).move_to(goal, 0.5).move_to(zero, 1.0, 2.0).dwell(1.0);
  Setpoint last = s.sample(0.0);
  const double h = 1e-3;
  for (double t = h; t < s.duration() + 0.5; t += h) {
    const Setpoint p = s.sample(t);
    for (std::size_t j = 0; j < n; ++j) {
      ASSERT_LE(std::abs(p.q[j] - last.q[j]), 1.0 * h);
      ASSERT_LE(std::abs(p.dq[j] - last.dq[j]), 2.0 * h);
    }
    last = p;
  }
  EXPECT_EQ(s.sample(s.duration()).q, zero);
}

TEST(Schedule, EmptyStandsAtTheStart) {
  const Schedule s(n, goal);
  EXPECT_EQ(s.duration(), 0.0);
  EXPECT_EQ(s.sample(3.0).q, goal);
  EXPECT_EQ(s.phase(0.0).index, -1);
  EXPECT_TRUE(s.phase(0.0).finished);
}

TEST(Trajectory, SamplingAllocatesNothing) {
  Schedule s(n, zero);
  s.move_to(goal, 0.5).dwell(1.0);
  const Quintic q(n, zero, goal, 1.0);
  double sum = 0.0;
  palpate::test::AllocationCounter counter;
  for (int k = 0; k < 100; ++k) sum += s.sample(0.05 * k).q[0] + q.sample(0.01 * k).q[0] + s.phase(0.05 * k).elapsed;
  EXPECT_EQ(counter.count(), 0u);
  EXPECT_GT(sum, 0.0);
}

TEST(Trajectory, ConstructorsNameWhatIsWrong) {
  const auto message = [](auto make) -> std::string {
    try {
      make();
    } catch (const std::invalid_argument& e) {
      return e.what();
    }
    return "nothing thrown";
  };
  EXPECT_EQ(message([] { Quintic(n, zero, goal, -1.0); }), "Quintic duration [s] = -1: expected a finite number >= 0");
  EXPECT_EQ(message([] { Quintic(n, zero, goal, 0.0); }), "Quintic duration [s] = 0: expected more than 0, because joint 0 has to move");
  EXPECT_EQ(message([] { Quintic(n, zero, {0.0, nan}, 1.0); }), "Quintic goal[1] [rad] = nan: expected a finite number");
  EXPECT_EQ(message([] { (void)Quintic::within_limits(n, zero, goal, 0.0); }),
            "Quintic max_speed[0] [rad/s] = 0: expected a number > 0, or infinity for no limit");
  EXPECT_EQ(message([] { (void)Quintic::within_limits(n, zero, goal, inf); }),
            "Quintic max_speed[0] [rad/s] = inf: expected a finite limit of speed or acceleration for a joint that moves");
  EXPECT_EQ(message([] { Schedule(n, zero).dwell(nan); }), "Schedule dwell [s] = nan: expected a finite number >= 0");
  EXPECT_EQ(message([] {
              Schedule s(n, zero);
              for (int k = 0; k < 33; ++k) s.move_in(goal, 1.0);
            }),
            "Schedule motions = 33: expected at most 32");
}

}  // namespace
