// The payload Kalman filter: what it weighs, how sure it is, what it notices, and what it survives.
#include "palpate/payload_filter.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <limits>
#include <string>

#include "no_alloc.hpp"
#include "palpate/conditioner.hpp"
#include "test_bench.hpp"

using namespace palpate;
using palpate_test::at;
using palpate_test::independent;
using palpate_test::Plant;
using palpate_test::Random;
using palpate_test::Recording;
using palpate_test::Scene;
using palpate_test::simulate;

namespace {

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double inf = std::numeric_limits<double>::infinity();

/// A random arm of five joints (the last prismatic) with sensors of servo quality.
ArmDescription description(std::uint64_t seed, int n = 5) {
  Random r = independent(seed);
  ArmDescription d = palpate_test::random_description(r, n);
  for (int j = 0; j < n; ++j) {
    JointDescription& J = d.joints[at(j)];
    J.rotor_inertia = 0.05;
    J.friction = {.viscous = 0.3};
    J.position_std = 2e-4;
    J.torque_std = 0.1;
  }
  return d;
}
JointVector pose(int n) {
  JointVector q{};
  for (int j = 0; j < n; ++j) q[at(j)] = 0.5 - 0.4 * (j % 3);
  return q;
}

/// A recording as the sensors of the arm see it: noise, then rounding to counts.
std::vector<RawSample> sensed(const Arm& arm, const Recording& recording, std::uint64_t seed) {
  Random r = independent(seed);
  std::vector<RawSample> out;
  for (RawSample raw : recording.raw) {
    raw.has_velocity = raw.has_model_torque = false;
    for (int j = 0; j < arm.n(); ++j) {
      const JointDescription& J = arm.joint(j);
      raw.position[at(j)] += J.position_std * r.normal();
      if (J.position_resolution > 0.0)
        raw.position[at(j)] = J.position_resolution * std::round(raw.position[at(j)] / J.position_resolution);
      raw.effort[at(j)] += J.torque_std * r.normal();
      if (J.torque_resolution > 0.0) raw.effort[at(j)] = J.torque_resolution * std::round(raw.effort[at(j)] / J.torque_resolution);
    }
    out.push_back(raw);
  }
  return out;
}

/// Conditioner and filter, as the pipeline joins them.
class Scale {
 public:
  explicit Scale(const Arm& arm, const PayloadFilterConfig& config = {}) : conditioner_(arm.n(), ones()), filter_(arm, config) {}
  Payload step(const RawSample& raw) noexcept { return filter_.step(conditioner_.step(raw)); }
  Payload feed(const std::vector<RawSample>& samples) noexcept {
    Payload out;
    for (const RawSample& raw : samples) out = step(raw);
    return out;
  }
  const PayloadFilter& filter() const { return filter_; }

 private:
  static JointVector ones() {
    JointVector one;
    one.fill(1.0);
    return one;
  }
  Conditioner conditioner_;
  PayloadFilter filter_;
};

void expect_finite(const Payload& p) {
  EXPECT_TRUE(std::isfinite(p.mass) && std::isfinite(p.mass_std) && p.mass_std >= 0.0);
  for (std::size_t k = 0; k < 3; ++k) EXPECT_TRUE(std::isfinite(p.first_moment[k]) && std::isfinite(p.first_moment_std[k]));
}
void expect_same(const Payload& a, const Payload& b) {
  EXPECT_EQ(a.mass, b.mass);
  EXPECT_EQ(a.mass_std, b.mass_std);
  EXPECT_EQ(a.first_moment, b.first_moment);
  EXPECT_EQ(a.changes, b.changes);
  EXPECT_EQ(a.change_time_ns, b.change_time_ns);
  EXPECT_EQ(a.status, b.status);
}

TEST(PayloadFilter, WeighsAtRestAndInMotion) {
  for (std::uint64_t seed = 1; seed <= 5; ++seed)
    for (double swing : {0.0, 0.6}) {
      const Arm arm(description(seed));
      const double mass = 0.1 + 0.1 * static_cast<double>(seed);  // no more than the arm's own light links
      Scene scene{.seconds = 3.0, .swing = swing, .q0 = pose(5)};
      scene.events = [&](double, Plant& plant) { plant.load = palpate_test::point_load(arm, mass); };
      Scale scale(arm);
      const Payload seen = scale.feed(sensed(arm, simulate(arm, scene), seed));
      SCOPED_TRACE("arm " + std::to_string(seed) + ", swing " + std::to_string(swing));
      EXPECT_EQ(seen.status, Status::ok) << name(seen.status);
      EXPECT_NEAR(seen.mass, mass, std::max(0.02 * mass, 3.5 * seen.mass_std));
      EXPECT_LT(seen.mass_std, 0.03 * mass);
      EXPECT_EQ(seen.changes, 0u);
      EXPECT_NEAR(scale.filter().load().m, seen.mass, 1e-15);
    }
}

TEST(PayloadFilter, AnEmptyHandWeighsNothing) {
  for (std::uint64_t seed = 1; seed <= 5; ++seed) {
    const Arm arm(description(seed));
    Scale scale(arm);
    const Payload seen = scale.feed(sensed(arm, simulate(arm, {.seconds = 3.0, .q0 = pose(5)}), seed));
    EXPECT_EQ(seen.status, Status::ok) << name(seen.status);
    EXPECT_NEAR(seen.mass, 0.0, 3.5 * seen.mass_std);
    EXPECT_LT(seen.mass_std, 0.01);
    EXPECT_GE(scale.filter().load().m, 0.0);
  }
}

TEST(PayloadFilter, ANegativeLoadIsANumberToo) {  // model or calibration off by that much: said, never NaN
  const Arm arm(description(1));
  Scene scene{.seconds = 2.0, .q0 = pose(5)};
  scene.events = [&](double, Plant& plant) { plant.push = palpate_test::weight_torque(arm, plant.q, -0.8); };
  for (bool offset : {false, true}) {
    Scale scale(arm, {.first_moment = offset});
    Payload seen;
    for (const RawSample& raw : sensed(arm, simulate(arm, scene), 1)) {
      seen = scale.step(raw);
      expect_finite(seen);
    }
    EXPECT_NEAR(seen.mass, -0.8, 0.1);
    EXPECT_EQ(scale.filter().load().m, 0.0);  // no body of negative mass for the controller
  }
}

TEST(PayloadFilter, FindsTheOffsetOfTheLoad) {
  for (std::uint64_t seed = 1; seed <= 5; ++seed) {
    const Arm arm(description(seed));
    const double mass = 0.5;
    const double tolerance = 0.01;  // in motion as fast as this the interval is a little too narrow, whatever the prior [kg m]
    const Vec3<double> delta{0.03, -0.04, 0.02};  // tip axes
    Scene scene{.seconds = 4.0, .swing = 1.0, .q0 = pose(5)};
    scene.events = [&](double, Plant& plant) {
      plant.load = about_origin(mass, arm.p_last_grasp() + arm.R_last_tip() * delta, Sym3<double>{});
    };
    Scale scale(arm, {.first_moment = true});
    const Payload seen = scale.feed(sensed(arm, simulate(arm, scene), seed));
    SCOPED_TRACE("arm " + std::to_string(seed));
    EXPECT_NEAR(seen.mass, mass, 3.5 * seen.mass_std + 0.01);
    EXPECT_NEAR(seen.first_moment[0], mass * delta.x, 3.5 * seen.first_moment_std[0] + tolerance);
    EXPECT_NEAR(seen.first_moment[1], mass * delta.y, 3.5 * seen.first_moment_std[1] + tolerance);
    EXPECT_NEAR(seen.first_moment[2], mass * delta.z, 3.5 * seen.first_moment_std[2] + tolerance);
    for (double std : seen.first_moment_std) EXPECT_LT(std, 0.03);
  }
}

TEST(PayloadFilter, ItsIntervalIsHonestWithoutStiction) {  // nearly linear: sensors' noise alone
  constexpr int runs = 60;
  const Arm arm(description(2, 3));
  const double mass = 0.8;
  for (double swing : {0.0, 0.5}) {
    Scene scene{.seconds = 1.5, .swing = swing, .q0 = pose(3)};
    scene.events = [&](double, Plant& plant) { plant.load = palpate_test::point_load(arm, mass); };
    const Recording truth = simulate(arm, scene);
    int inside = 0, changes = 0;
    double squares = 0.0;
    for (std::uint64_t seed = 1; seed <= runs; ++seed) {
      Scale scale(arm);
      const Payload seen = scale.feed(sensed(arm, truth, seed));
      const double error = (seen.mass - mass) / seen.mass_std;
      inside += std::abs(error) <= 1.96;
      squares += error * error;
      changes += static_cast<int>(seen.changes);
    }
    std::printf("swing %.1f: %d of %d intervals of 95 %% cover, normalised squared error %.2f\n", swing, inside, runs, squares / runs);
    EXPECT_GE(inside, 0.85 * runs);
    EXPECT_LT(squares / runs, 1.0 + 3.3 * std::sqrt(2.0 / runs));
    EXPECT_EQ(changes, 0);
  }
}

TEST(PayloadFilter, StictionKeepsTheIntervalWideAndItCovers) {
  ArmDescription d = description(2, 3);
  d.gravity = {0, 0, -9.81};
  for (int j = 0; j < 3; ++j) {
    JointDescription& J = d.joints[at(j)];
    J.friction = {.coulomb = 1.5, .viscous = 0.3};
    J.position_resolution = 1.5e-3;
    J.position_std = 1e-4;
  }
  const Arm arm(d);
  const JointVector q = pose(3);
  const double mass = 0.8;
  const JointVector g = gravity_torque<double>(arm, q, palpate_test::point_load(arm, mass));
  constexpr int runs = 60;
  int inside = 0, changes = 0;
  double least = inf;
  for (std::uint64_t seed = 1; seed <= runs; ++seed) {
    Random r = independent(seed);
    Scale scale(arm);
    Payload seen;
    const JointVector stuck{r(-1.5, 1.5), r(-1.5, 1.5), r(-1.5, 1.5)};  // the joints stick: any torque within F_c will do
    for (int k = 0; k < 500; ++k) {
      RawSample raw;
      raw.time_ns = 4'000'000ll * k;
      for (int j = 0; j < 3; ++j) {
        raw.position[at(j)] = 1.5e-3 * std::round((q[at(j)] + 1e-4 * r.normal()) / 1.5e-3);
        raw.effort[at(j)] = g[at(j)] + stuck[at(j)] + 0.1 * r.normal();
      }
      seen = scale.step(raw);
    }
    inside += std::abs(seen.mass - mass) <= 1.96 * seen.mass_std;
    least = std::min(least, seen.mass_std);
    changes += static_cast<int>(seen.changes);
  }
  // one joint with its lever, F_c/sqrt(3), sets the scale
  double best = inf;
  const JointVector lever = palpate_test::weight_torque(arm, q, 1.0);
  for (int j = 0; j < 3; ++j) best = std::min(best, 1.5 / std::sqrt(3.0) / std::abs(lever[at(j)]));
  std::printf("stiction: %d of %d cover; least std %.3f kg, one joint alone allows %.3f kg\n", inside, runs, least, best);
  EXPECT_GE(inside, 0.85 * runs);
  EXPECT_GT(least, 0.3 * best);
  EXPECT_EQ(changes, 0);
}

TEST(PayloadFilter, NoticesGraspAndRelease) {
  for (std::uint64_t seed = 1; seed <= 4; ++seed) {
    const Arm arm(description(seed));
    const double mass = 0.7, grasp = 2.013, release = 4.207;
    Scene scene{.seconds = 6.0, .swing = 0.3, .q0 = pose(5)};
    scene.events = [&](double t, Plant& plant) { plant.load = palpate_test::point_load(arm, t >= grasp && t < release ? mass : 0.0); };
    Scale scale(arm);
    Payload seen;
    double noticed[2] = {inf, inf};
    for (const RawSample& raw : sensed(arm, simulate(arm, scene), seed)) {
      const std::uint32_t before = seen.changes;
      seen = scale.step(raw);
      const double t = static_cast<double>(raw.time_ns) / 1e9;
      if (seen.changes > before && seen.changes <= 2) {
        noticed[seen.changes - 1] = t;
        EXPECT_NEAR(static_cast<double>(seen.change_time_ns) / 1e9, seen.changes == 1 ? grasp : release, 0.3);
      }
      if (t > release - 0.1 && t < release) EXPECT_NEAR(seen.mass, mass, 0.05 * mass) << "arm " << seed;
    }
    SCOPED_TRACE("arm " + std::to_string(seed));
    EXPECT_EQ(seen.changes, 2u);
    EXPECT_GT(noticed[0], grasp);
    EXPECT_LT(noticed[0], grasp + 0.5);
    EXPECT_GT(noticed[1], release);
    EXPECT_LT(noticed[1], release + 0.5);
    EXPECT_NEAR(seen.mass, 0.0, 0.05 * mass);
  }
}

TEST(PayloadFilter, APushIsNoMass) {  // level, at the grasp point: no load at any place of the hand takes such torques
  for (std::uint64_t seed = 1; seed <= 6; ++seed)
    for (double begin : {0.0, 2.0}) {
      const Arm arm(description(seed));
      const double mass = 0.7, end = begin + 2.0;
      const Vec3<double> g = arm.gravity(), level = cross(g, Vec3<double>{0.3, -0.5, 0.8});
      const Vec3<double> force = (5.0 / std::sqrt(dot(level, level))) * level;
      Scene scene{.seconds = end + 3.0, .swing = seed % 2 == 0 ? 0.3 : 0.0, .q0 = pose(5)};
      scene.events = [&](double t, Plant& plant) {
        plant.load = palpate_test::point_load(arm, mass);
        plant.push = {};
        if (t < begin || t >= end) return;
        const Pose<double> P = forward_kinematics<double>(arm, plant.q);
        const Vec3<double> c = P.p + P.R * arm.p_last_grasp();
        for (int j = 0; j < arm.n(); ++j) plant.push[at(j)] = dot(jacobian_column(arm, P, j, c), force);
      };
      Scale scale(arm);
      Payload seen;
      int pushed = 0, wrong = 0;
      for (const RawSample& raw : sensed(arm, simulate(arm, scene), seed)) {
        seen = scale.step(raw);
        const double t = static_cast<double>(raw.time_ns) / 1e9;
        if (t < begin || t >= end) continue;
        ++pushed;
        wrong += seen.status == Status::ok && std::abs(seen.mass - mass) > 3.0 * seen.mass_std;
      }
      SCOPED_TRACE("arm " + std::to_string(seed) + ", push from " + std::to_string(begin) + " s");
      EXPECT_LE(wrong, 0.03 * pushed);
      EXPECT_EQ(seen.status, Status::ok) << name(seen.status);
      EXPECT_NEAR(seen.mass, mass, std::max(0.02 * mass, 3.5 * seen.mass_std));
    }
}

TEST(PayloadFilter, InfinityDeclaresNoChange) {
  const Arm arm(description(1));
  Scene scene{.seconds = 3.0, .q0 = pose(5)};
  scene.events = [&](double t, Plant& plant) { plant.load = palpate_test::point_load(arm, t >= 1.5 ? 0.7 : 0.0); };
  Scale scale(arm, {.change_threshold = inf});
  EXPECT_EQ(scale.feed(sensed(arm, simulate(arm, scene), 1)).changes, 0u);
}

TEST(PayloadFilter, AQuietRunHasNoChanges) {
  for (std::uint64_t seed = 1; seed <= 4; ++seed) {
    ArmDescription d = description(seed);
    for (int j = 0; j < 5; ++j) {
      JointDescription& J = d.joints[at(j)];
      J.position_resolution = 1.5e-3;
      J.torque_resolution = 0.2;
      if (seed % 2 == 0) J.friction.coulomb = 0.3;
    }
    const Arm arm(d);
    Scene scene{.seconds = 12.0, .swing = seed < 3 ? 0.4 : 0.0, .q0 = pose(5)};
    scene.events = [&](double, Plant& plant) { plant.load = palpate_test::point_load(arm, 0.5); };
    Scale scale(arm);
    const Payload seen = scale.feed(sensed(arm, simulate(arm, scene), seed));
    EXPECT_EQ(seen.changes, 0u) << "arm " << seed;
    EXPECT_NEAR(seen.mass, 0.5, 4.0 * seen.mass_std + 0.01) << "arm " << seed;
  }
}

TEST(PayloadFilter, AGapForgetsTheLoadAndLearnsItAnew) {
  const Arm arm(description(1));
  Scene scene{.seconds = 15.0, .swing = 0.3, .q0 = pose(5), .longest_step = 2e-3};
  scene.events = [&](double t, Plant& plant) { plant.load = palpate_test::point_load(arm, t < 6.0 ? 0.3 : 1.2); };
  Scale scale(arm);
  bool gap = false;
  Payload seen, before;
  double learnt = inf;
  for (const RawSample& raw : sensed(arm, simulate(arm, scene), 1)) {
    const double t = static_cast<double>(raw.time_ns) / 1e9;
    if (t > 2.0 && t < 12.0) continue;  // ten seconds of silence, the load is exchanged
    seen = scale.step(raw);
    if (t <= 2.0) before = seen;
    if (t >= 12.0 && !gap) {
      EXPECT_EQ(seen.status, Status::gap);
      EXPECT_EQ(seen.mass, before.mass);       // the last good value
      EXPECT_GE(seen.mass_std, 1.0);           // and no confidence in it
      gap = true;
    } else if (gap && seen.status == Status::ok) {
      learnt = std::min(learnt, t);
      EXPECT_NEAR(seen.mass, 1.2, 4.0 * seen.mass_std + 0.01) << t;
    }
  }
  EXPECT_TRUE(gap);
  EXPECT_LT(learnt, 14.0);
}

TEST(PayloadFilter, RefusedSamplesAreHeldAndChangeNothing) {
  const Arm arm(description(1));
  Scene scene{.seconds = 1.0, .q0 = pose(5)};
  scene.events = [&](double, Plant& plant) { plant.load = palpate_test::point_load(arm, 0.5); };
  Scale clean(arm), dirty(arm);
  int k = 0;
  for (const RawSample& raw : sensed(arm, simulate(arm, scene), 1)) {
    const Payload before = clean.step(raw);
    expect_same(dirty.step(raw), before);
    RawSample bad = raw;
    bad.time_ns += k % 3 == 0 ? -1000 : 1000;
    const double junk[] = {nan, inf, -1e300, 1e300};
    if (k % 2) bad.position[at(k % 5)] = junk[k % 4];
    else bad.effort[at(k % 5)] = junk[k % 4];
    const Payload held = dirty.step(bad);
    EXPECT_EQ(held.status, Status::held);
    EXPECT_EQ(held.mass, before.mass);
    EXPECT_EQ(held.mass_std, before.mass_std);
    ++k;
  }
}

TEST(PayloadFilter, SurvivesWhatTheConditionerLetsThrough) {  // absurd but finite: jumps, huge torques, a clock set back
  const Arm arm(description(1));
  Scene scene{.seconds = 12.0, .q0 = pose(5), .longest_step = 2e-3};
  scene.events = [&](double, Plant& plant) { plant.load = palpate_test::point_load(arm, 0.5); };
  std::vector<RawSample> raw = sensed(arm, simulate(arm, scene), 1);
  for (bool offset : {false, true}) {
    Scale scale(arm, {.first_moment = offset});
    Payload seen;
    int reset_clock = 0;
    for (std::size_t k = 0; k < raw.size(); ++k) {
      RawSample r = raw[k];
      const double t = static_cast<double>(r.time_ns) / 1e9;
      if (t > 1.0 && t < 3.0) {
        if (k % 20 == 0) r.effort[k % 5] = 1e6;
        if (k % 20 == 5) r.effort[k % 5] = -1e6;
        if (k % 20 == 10) r.position[k % 5] += 30.0;
        if (k % 20 == 15) r.position[k % 5] = -1e6;
      }
      if (t > 3.0) r.time_ns -= 2'500'000'000, ++reset_clock;
      seen = scale.step(r);
      expect_finite(seen);
      const Inertia<double> load = scale.filter().load();
      EXPECT_TRUE(std::isfinite(load.m) && std::isfinite(load.mc.x) && std::isfinite(load.I.xx));
    }
    EXPECT_NEAR(seen.mass, 0.5, 0.05 + 4.0 * seen.mass_std) << name(seen.status);  // it may still be warming
  }
}

TEST(PayloadFilter, OneWrongReadingIsNoLoadThatIsSaidToBeOk) {  // an encoder or a current that is nonsense for one sample, within all limits
  const Arm arm(description(1));
  Scene scene{.seconds = 4.0, .q0 = pose(5)};
  scene.events = [&](double, Plant& plant) { plant.load = palpate_test::point_load(arm, 0.5); };
  const std::vector<RawSample> clean = sensed(arm, simulate(arm, scene), 1);
  const auto run = [&](double radians, double torque) {
    std::vector<RawSample> raw = clean;
    raw[500].position[2] += radians;
    raw[500].effort[2] += torque;
    Scale scale(arm);
    Payload seen;
    for (std::size_t k = 0; k < raw.size(); ++k) {
      seen = scale.step(raw[k]);
      if (k > 490 && seen.status == Status::ok)
        ASSERT_NEAR(seen.mass, 0.5, 8.0 * seen.mass_std) << radians << " rad, " << torque << " N m, sample " << k;
    }
  };
  for (double radians : {0.03, 0.3, -1.0}) run(radians, 0.0);
  for (double torque : {100.0, -1e3, 1e6}) run(0.0, torque);
}

TEST(PayloadFilter, LongIntervalsAreSplit) {  // 10 Hz, just below the gap
  const Arm arm(description(3, 3));
  Scene scene{.seconds = 20.0, .rate = 12.0, .swing = 0.2, .stiffness = 2.0, .q0 = pose(3), .longest_step = 2e-3};
  scene.events = [&](double, Plant& plant) { plant.load = palpate_test::point_load(arm, 0.5); };
  Scale scale(arm);
  const Payload seen = scale.feed(sensed(arm, simulate(arm, scene), 1));
  EXPECT_NEAR(seen.mass, 0.5, 3.5 * seen.mass_std + 0.01);
  EXPECT_EQ(seen.changes, 0u);
}

TEST(PayloadFilter, ResetIsNewAndAChunkedRunIsTheWholeRun) {
  const Arm arm(description(1));
  const std::vector<RawSample> raw = sensed(arm, simulate(arm, {.seconds = 1.0, .q0 = pose(5)}), 1);
  PayloadFilter whole(arm), piece(arm);
  JointVector one;
  one.fill(1.0);
  Conditioner conditioner(5, one);
  std::vector<JointSample> samples;
  for (const RawSample& r : raw) samples.push_back(conditioner.step(r));
  for (const JointSample& s : samples) (void)piece.step(s);
  piece.reset();
  for (std::size_t k = 0; k < samples.size(); ++k) {
    if (k % 37 == 0) piece = PayloadFilter(piece);
    expect_same(piece.step(samples[k]), whole.step(samples[k]));
    EXPECT_EQ(piece.positions(), whole.positions());
  }
}

TEST(PayloadFilter, ThePriorIsWhatTheArmCanHold) {
  ArmDescription d;
  d.n = 1;
  d.joints[0].axis = {0, 1, 0};
  d.joints[0].mass = 0.2;
  d.joints[0].inertia = {1e-3, 0, 0, 1e-3, 0, 1e-3};
  d.joints[0].max_effort = 4.0;
  d.grasp = {0.5, 0, 0};
  JointSample s;
  s.status = Status::ok;
  const Arm limited(d);
  EXPECT_NEAR(PayloadFilter(limited).step(s).mass_std, 4.0 / (9.81 * 0.5), 1e-12);
  d.joints[0].max_effort = inf;
  const Arm unlimited(d);
  EXPECT_EQ(PayloadFilter(unlimited).step(s).mass_std, 5.0);
  EXPECT_EQ(PayloadFilter(unlimited, {.mass_prior_std = 2.0}).step(s).mass_std, 2.0);
  d.joints[0].max_effort = 4.0;
  d.gravity = {0, 0, 0};
  const Arm orbit(d);
  EXPECT_EQ(PayloadFilter(orbit).step(s).mass_std, 5.0);
}

TEST(PayloadFilter, InOrbitItWeighsByInertiaAndOnlyInMotion) {
  ArmDescription d = description(1);
  d.gravity = {0, 0, 0};
  const Arm arm(d);
  for (double swing : {0.0, 1.5}) {
    Scene scene{.seconds = 4.0, .swing = swing, .q0 = pose(5)};
    scene.events = [&](double, Plant& plant) { plant.load = palpate_test::point_load(arm, 1.5); };
    Scale scale(arm);
    const Payload seen = scale.feed(sensed(arm, simulate(arm, scene), 1));
    if (swing == 0.0) EXPECT_GT(seen.mass_std, 0.3);
    else EXPECT_LT(seen.mass_std, 0.3);
    EXPECT_NEAR(seen.mass, 1.5, 3.5 * seen.mass_std);
  }
}

TEST(PayloadFilter, AllocatesNothing) {
  const Arm arm(description(1));
  const std::vector<RawSample> raw = sensed(arm, simulate(arm, {.seconds = 0.4, .q0 = pose(5)}), 1);
  PayloadFilter filter(arm, {.first_moment = true});
  static_assert(noexcept(filter.step({})));
  Conditioner conditioner(5, JointVector{1, 1, 1, 1, 1});
  palpate::test::AllocationCounter counter;
  for (const RawSample& r : raw) (void)filter.step(conditioner.step(r));
  EXPECT_EQ(counter.count(), 0u);
}

TEST(PayloadFilter, ConstructorNamesTheOption) {
  const Arm arm(description(1));
  const auto refusal = [](auto make) -> std::string {
    try {
      make();
    } catch (const std::invalid_argument& e) {
      return e.what();
    }
    return "nothing thrown";
  };
  const auto names = [&](const char* option, auto make) {
    for (double junk : {-1.0, inf, -inf}) {
      const std::string message = refusal([&] { make(junk); });
      EXPECT_NE(message.find(option), std::string::npos) << option << " = " << junk << ": " << message;
    }
  };
  names("PayloadFilterConfig mass_prior_std", [&](double x) { PayloadFilter(arm, {.mass_prior_std = x}); });
  names("PayloadFilterConfig offset_prior_std", [&](double x) { PayloadFilter(arm, {.offset_prior_std = x}); });
  names("PayloadFilterConfig velocity_prior_std", [&](double x) { PayloadFilter(arm, {.velocity_prior_std = x}); });
  names("PayloadFilterConfig model_torque_std", [&](double x) { PayloadFilter(arm, {.model_torque_std = x}); });
  names("PayloadFilterConfig friction_fraction", [&](double x) { PayloadFilter(arm, {.friction_fraction = x}); });
  names("PayloadFilterConfig friction_time", [&](double x) { PayloadFilter(arm, {.friction_time = x}); });
  names("PayloadFilterConfig change_threshold", [&](double x) { PayloadFilter(arm, {.change_threshold = x > 0.0 ? nan : x}); });
  names("PayloadFilterConfig min_change", [&](double x) { PayloadFilter(arm, {.min_change = x}); });
  names("PayloadFilterConfig max_step", [&](double x) { PayloadFilter(arm, {.max_step = x}); });
  names("PayloadFilterConfig ok_relative", [&](double x) { PayloadFilter(arm, {.ok_relative = x}); });
  names("PayloadFilterConfig ok_absolute", [&](double x) { PayloadFilter(arm, {.ok_absolute = x}); });
  ArmDescription d;
  d.n = 1;
  EXPECT_EQ(refusal([&] {
              const Arm bare(d);
              PayloadFilter f(bare);
            }),
            "PayloadFilter: the arm has no masses; give inertials");
}

}  // namespace
