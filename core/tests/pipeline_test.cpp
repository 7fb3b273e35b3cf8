// The one path: every combination of observer and estimator, on good samples and on garbage.
#include "palpate/pipeline.hpp"

#include <gtest/gtest.h>

#include <chrono>
#include <cstring>
#include <limits>
#include <string>

#include "no_alloc.hpp"
#include "test_bench.hpp"

using namespace palpate;
using palpate_test::at;
using palpate_test::independent;
using palpate_test::Plant;
using palpate_test::Random;
using palpate_test::Scene;
using palpate_test::simulate;

namespace {

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double inf = std::numeric_limits<double>::infinity();

ArmDescription description(int n) {
  Random r = independent(11);
  ArmDescription d = palpate_test::random_description(r, n);
  for (int j = 0; j < n; ++j) {
    JointDescription& J = d.joints[at(j)];
    J.rotor_inertia = 0.1;
    J.friction = {.coulomb = 0.2, .viscous = 0.4, .sign_velocity = 0.05};
    J.position_std = 1e-4;
    J.position_resolution = 2e-4;
    J.torque_std = 0.05;
    J.torque_gain_std = 0.01;
    J.effort_gain = j % 2 ? -0.5 : 2.0;
  }
  return d;
}
std::shared_ptr<const Arm> make_arm(int n = 5) { return std::make_shared<const Arm>(description(n)); }
JointVector pose(int n) {
  JointVector q{};
  for (int j = 0; j < n; ++j) q[at(j)] = 0.5 - 0.4 * (j % 3);
  return q;
}

/// What the drivers of a swinging arm that holds `mass` read: noise, counts, amperes.
std::vector<RawSample> readings(const Arm& arm, double seconds, double mass, std::uint64_t seed, double swing = 0.4) {
  Scene scene{.seconds = seconds, .swing = swing, .q0 = pose(arm.n())};
  scene.events = [&](double, Plant& plant) { plant.load = palpate_test::point_load(arm, mass); };
  Random r = independent(seed);
  std::vector<RawSample> out = simulate(arm, scene).raw;
  for (RawSample& raw : out) {
    raw.has_velocity = false;
    for (int j = 0; j < arm.n(); ++j) {
      const JointDescription& J = arm.joint(j);
      raw.position[at(j)] = J.position_resolution * std::round((raw.position[at(j)] + J.position_std * r.normal()) / J.position_resolution);
      raw.effort[at(j)] = (raw.effort[at(j)] + J.torque_std * r.normal()) / J.effort_gain;
    }
  }
  return out;
}

struct Named {
  std::string name;
  PipelineConfig config;
};
/// Every observer with every estimator, wrench and contact beside them.
std::vector<Named> combinations() {
  const std::vector<std::pair<std::string, ObserverConfig>> observers{
      {"none", std::monostate{}},
      {"inverse dynamics", InverseDynamicsConfig{}},
      {"model residual", ModelResidualConfig{}},
      {"sliding mode, Euler", SlidingModeConfig{.lambda = 30.0, .alpha = 80.0, .cutoff = 10.0, .solver = Solver::euler}},
      {"sliding mode, Runge-Kutta", SlidingModeConfig{.lambda = 30.0, .alpha = 80.0, .cutoff = 10.0}},
      {"sliding mode, Dormand-Prince, true sign",
       SlidingModeConfig{.lambda = 30.0, .alpha = 80.0, .gamma = 0.0, .cutoff = 10.0, .solver = Solver::dormand_prince}},
      {"momentum", MomentumConfig{}},
      {"super-twisting", SuperTwistingConfig{.max_rate = 200.0}},
      {"disturbance Kalman", DisturbanceKalmanConfig{}},
      {"extended Kalman", ExtendedKalmanConfig{}},
      {"extended Kalman, smoothing only", ExtendedKalmanConfig{.disturbance = false}},
  };
  const std::vector<std::pair<std::string, PayloadConfig>> estimators{
      {"none", std::monostate{}},         {"joint formula", JointFormulaConfig{}},
      {"regression", RegressionConfig{}}, {"regression with offset", RegressionConfig{.first_moment = true}},
      {"filter", PayloadFilterConfig{}},  {"filter with offset", PayloadFilterConfig{.first_moment = true}},
  };
  std::vector<Named> out;
  for (const auto& [o, observer] : observers)
    for (const auto& [e, estimator] : estimators) {
      const bool alone = std::holds_alternative<std::monostate>(observer);
      if (alone && (std::holds_alternative<JointFormulaConfig>(estimator) || std::holds_alternative<RegressionConfig>(estimator))) continue;
      PipelineConfig c;
      c.observer = observer;
      c.payload = estimator;
      if (!alone) c.wrench.emplace();
      c.contact.emplace();
      out.push_back({o + " + " + e, c});
    }
  return out;
}

/// Whether a number that is not finite hides in what claims to be `ok` (or, with any = true, anywhere).
template <class... Arrays>
bool finite(const Arrays&... arrays) {
  const auto one = [](const auto& a) {
    for (double x : a)
      if (!std::isfinite(x)) return false;
    return true;
  };
  return (one(arrays) && ...);
}
std::string nonsense(const Touch& t) {
  if (!finite(t.q, t.dq)) return "q or dq";
  if (!finite(t.external.torque, t.external.std, t.external.noise)) return std::string("external, ") + name(t.external.status);
  if (!std::isfinite(t.payload.mass) || !std::isfinite(t.payload.mass_std) || !finite(t.payload.first_moment, t.payload.first_moment_std))
    return std::string("payload, ") + name(t.payload.status);
  if (!finite(t.wrench.force, t.wrench.moment, t.wrench.force_std, t.wrench.moment_std, t.wrench.covariance) ||
      std::isnan(t.wrench.conditioning))
    return std::string("wrench, ") + name(t.wrench.status);
  if (!finite(t.contact.torque, t.contact.std, t.contact.level)) return std::string("contact, ") + name(t.contact.status);
  for (double x : t.external.std)
    if (x < 0.0) return "external std < 0";
  if (t.payload.mass_std < 0.0) return "mass_std < 0";
  return {};
}

bool same(const Touch& a, const Touch& b) {
  const auto bits = [](const auto& x, const auto& y) { return std::memcmp(&x, &y, sizeof x) == 0; };
  return a.time_ns == b.time_ns && a.status == b.status && bits(a.q, b.q) && bits(a.dq, b.dq) &&
         bits(a.external.torque, b.external.torque) && bits(a.external.std, b.external.std) && bits(a.external.noise, b.external.noise) &&
         a.external.status == b.external.status && bits(a.payload.mass, b.payload.mass) && bits(a.payload.mass_std, b.payload.mass_std) &&
         bits(a.payload.first_moment, b.payload.first_moment) && bits(a.payload.first_moment_std, b.payload.first_moment_std) &&
         a.payload.changes == b.payload.changes && a.payload.change_time_ns == b.payload.change_time_ns &&
         a.payload.status == b.payload.status && bits(a.wrench.force, b.wrench.force) && bits(a.wrench.moment, b.wrench.moment) &&
         bits(a.wrench.covariance, b.wrench.covariance) && a.wrench.status == b.wrench.status && bits(a.contact.torque, b.contact.torque) &&
         bits(a.contact.level, b.contact.level) && a.contact.count == b.contact.count && a.contact.active == b.contact.active &&
         a.contact.status == b.contact.status;
}

/// Readings with garbage strewn in: about every fifth is spoilt, now and then a whole burst.
std::vector<RawSample> spoilt(const std::vector<RawSample>& good, int n, std::uint64_t seed) {
  Random r = independent(seed);
  std::vector<RawSample> out;
  std::int64_t shift = 0;
  int burst = 0;
  for (RawSample raw : good) {
    raw.time_ns += shift;
    const auto pick = [&](int k) { return static_cast<int>(r(0, k)); };
    const double junk[] = {nan, inf, -inf, 1e300, -1e300, 1e18, 1e6, -1e6, 1e4, -300.0, 30.0, 1e-320, 0.0};
    if (burst == 0 && pick(150) == 0) burst = 30;
    if (burst > 0 || pick(6) == 0) {
      burst = std::max(0, burst - 1);
      const double x = junk[pick(13)];
      switch (pick(9)) {
        case 0: raw.position[at(pick(n))] = x; break;
        case 1: raw.effort[at(pick(n))] = x; break;
        case 2: raw.has_velocity = true, raw.velocity[at(pick(n))] = x; break;  // the rest are the true ones
        case 3: raw.model_torque[at(pick(n))] = x; break;
        case 4: raw.has_model_torque = false; break;
        case 5: raw.position.fill(x), raw.effort.fill(x); break;
        case 6: raw.time_ns -= static_cast<std::int64_t>(r(0, 1e8)); break;
        case 7: {
          const std::int64_t times[] = {std::numeric_limits<std::int64_t>::min(), 0, -1, raw.time_ns - 4'000'000};
          raw.time_ns = times[pick(4)];
          break;
        }
        default: {
          const std::int64_t jump = std::llround(r(-3e8, 2e9));  // the clock is set: a gap, or a new time base
          shift += jump;
          raw.time_ns += jump;
        }
      }
    }
    out.push_back(raw);
  }
  return out;
}

TEST(Pipeline, EveryCombinationRuns) {
  const auto arm = make_arm();
  const std::vector<RawSample> raw = readings(*arm, 3.0, 0.6, 1);
  for (const Named& c : combinations()) {
    SCOPED_TRACE(c.name);
    Pipeline pipeline(arm, c.config);
    Touch touch;
    for (const RawSample& r : raw) {
      touch = pipeline.step(r);
      ASSERT_EQ(nonsense(touch), "");
    }
    EXPECT_EQ(touch.time_ns, raw.back().time_ns);
    EXPECT_EQ(touch.status, Status::ok);
    const auto* kalman = std::get_if<ExtendedKalmanConfig>(&c.config.observer);
    const bool sees = !std::holds_alternative<std::monostate>(c.config.observer) && (kalman == nullptr || kalman->disturbance);
    EXPECT_EQ(touch.external.status == Status::ok, sees) << name(touch.external.status);
    if (std::holds_alternative<PayloadFilterConfig>(c.config.payload)) {
      EXPECT_EQ(touch.payload.status, Status::ok)
          << name(touch.payload.status) << ' ' << touch.payload.mass << ' ' << touch.payload.mass_std;
      EXPECT_NEAR(touch.payload.mass, 0.6, 4.0 * touch.payload.mass_std + 0.01);
      EXPECT_NEAR(pipeline.load().m, touch.payload.mass, 1e-12);
    } else {
      EXPECT_EQ(pipeline.load().m, 0.0);
    }
    if (std::holds_alternative<std::monostate>(c.config.payload)) EXPECT_EQ(touch.payload.status, Status::held);
  }
}

TEST(Pipeline, GarbageNeverMakesANumberThatIsNone) {
  const auto arm = make_arm();
  for (std::uint64_t seed = 1; seed <= 3; ++seed) {
    const std::vector<RawSample> good = readings(*arm, 3.0, 0.6, seed), raw = spoilt(good, arm->n(), seed);
    for (const Named& c : combinations()) {
      SCOPED_TRACE(c.name + ", seed " + std::to_string(seed));
      Pipeline pipeline(arm, c.config);
      palpate::test::AllocationCounter counter;
      std::size_t allocations = 0;
      for (std::size_t k = 0; k < raw.size(); ++k) {
        const std::size_t before = counter.count();
        const Touch touch = pipeline.step(raw[k]);
        allocations += counter.count() - before;
        ASSERT_EQ(nonsense(touch), "") << "sample " << k;
        const Inertia<double> load = pipeline.load();
        ASSERT_TRUE(std::isfinite(load.m) && load.m >= 0.0 && std::isfinite(load.I.xx)) << "sample " << k;
      }
      EXPECT_EQ(allocations, 0u);
    }
  }
}

TEST(Pipeline, AfterGarbageItIsItselfAgain) {
  const auto arm = make_arm();
  const std::vector<RawSample> good = readings(*arm, 7.0, 0.6, 4);
  const std::size_t half = 500;
  std::vector<RawSample> raw = spoilt({good.begin(), good.begin() + half}, arm->n(), 5);
  std::int64_t end = 0;
  for (const RawSample& r : raw) end = std::max(end, r.time_ns);
  raw.insert(raw.end(), good.begin() + half, good.end());
  for (const Named& c : combinations()) {
    SCOPED_TRACE(c.name);
    Pipeline garbage(arm, c.config), clean(arm, c.config);
    Touch touch, truth;
    for (const RawSample& r : raw) touch = garbage.step(r);
    for (const RawSample& r : good) truth = clean.step(r);
    EXPECT_EQ(touch.status, Status::ok) << name(touch.status);
    EXPECT_EQ(touch.external.status, truth.external.status) << name(touch.external.status);
    for (int j = 0; j < 5; ++j)
      EXPECT_NEAR(touch.external.torque[at(j)], truth.external.torque[at(j)], 0.2 + 3.0 * truth.external.std[at(j)]) << j;
    if (std::holds_alternative<PayloadFilterConfig>(c.config.payload)) {
      EXPECT_EQ(touch.payload.status, Status::ok) << touch.payload.mass << ' ' << touch.payload.mass_std;
      EXPECT_NEAR(touch.payload.mass, 0.6, 0.05);
    }
  }
}

TEST(Pipeline, AReplayIsTheSameBitForBitAndSoIsAReset) {
  const auto arm = make_arm();
  const std::vector<RawSample> raw = spoilt(readings(*arm, 1.5, 0.6, 6), arm->n(), 7);
  for (const Named& c : combinations()) {
    SCOPED_TRACE(c.name);
    Pipeline live(arm, c.config), replay(arm, c.config);
    std::vector<Touch> first;
    for (const RawSample& r : raw) first.push_back(live.step(r));
    live.reset();
    for (std::size_t k = 0; k < raw.size(); ++k) {
      ASSERT_TRUE(same(replay.step(raw[k]), first[k])) << "replay, sample " << k;
      ASSERT_TRUE(same(live.step(raw[k]), first[k])) << "reset, sample " << k;
    }
  }
}

TEST(Pipeline, UsesTheDriversUnits) {  // effort_gain, also negative
  const auto arm = make_arm(2);
  PipelineConfig c;
  c.observer = MomentumConfig{};
  c.payload = std::monostate{};
  Pipeline pipeline(arm, c);
  RawSample raw;
  Touch touch;
  const JointVector q = pose(2), g = gravity_torque<double>(*arm, q);
  for (int k = 0; k < 500; ++k) {
    raw.time_ns = 4'000'000ll * k;
    raw.position = q;
    for (int j = 0; j < 2; ++j) raw.effort[at(j)] = (g[at(j)] - (j ? -3.0 : 2.0)) / arm->joint(j).effort_gain;
    touch = pipeline.step(raw);
  }
  EXPECT_EQ(touch.external.status, Status::ok);
  EXPECT_NEAR(touch.external.torque[0], 2.0, 1e-6);
  EXPECT_NEAR(touch.external.torque[1], -3.0, 1e-6);
}

TEST(Pipeline, KeepsItsArmAlive) {
  PipelineConfig c;
  c.observer = MomentumConfig{};
  auto arm = make_arm(3);
  Pipeline pipeline(arm, c);
  std::weak_ptr<const Arm> watch = arm;
  arm.reset();
  EXPECT_FALSE(watch.expired());
  EXPECT_EQ(pipeline.arm().n(), 3);
  (void)pipeline.step({});
  pipeline.reset();
}

TEST(Pipeline, RefusalsNameTheOption) {
  const auto arm = make_arm(3);
  const auto refusal = [&](auto change) -> std::string {
    PipelineConfig c;
    c.observer = MomentumConfig{};
    change(c);
    try {
      Pipeline pipeline(arm, c);
    } catch (const std::invalid_argument& e) {
      return e.what();
    }
    return "nothing thrown";
  };
  const auto names = [&](const char* option, auto change) {
    EXPECT_NE(refusal(change).find(option), std::string::npos) << refusal(change);
  };
  names("nothing thrown", [](PipelineConfig&) {});
  names("ConditionerConfig max_gap", [](PipelineConfig& c) { c.conditioner.max_gap = -1.0; });
  names("Differentiator points", [](PipelineConfig& c) { c.conditioner.differentiator.points = 1; });
  names("InverseDynamicsConfig cutoff", [](PipelineConfig& c) { c.observer = InverseDynamicsConfig{.cutoff = 0.0}; });
  names("ModelResidualConfig cutoff", [](PipelineConfig& c) { c.observer = ModelResidualConfig{.cutoff = nan}; });
  names("SlidingModeConfig alpha", [](PipelineConfig& c) { c.observer = SlidingModeConfig{.alpha = -1.0}; });
  names("MomentumConfig bandwidth", [](PipelineConfig& c) { c.observer = MomentumConfig{.bandwidth = inf}; });
  names("SuperTwistingConfig max_rate", [](PipelineConfig& c) { c.observer = SuperTwistingConfig{.max_rate = 0.0}; });
  names("DisturbanceKalmanConfig decay", [](PipelineConfig& c) { c.observer = DisturbanceKalmanConfig{.decay = -1.0}; });
  names("ExtendedKalmanConfig max_step", [](PipelineConfig& c) { c.observer = ExtendedKalmanConfig{.max_step = 0.0}; });
  names("JointFormulaConfig joint = 3", [](PipelineConfig& c) { c.payload = JointFormulaConfig{.joint = 3}; });
  names("RegressionConfig bias_time", [](PipelineConfig& c) { c.payload = RegressionConfig{.bias_time = 0.0}; });
  names("PayloadFilterConfig ok_relative", [](PipelineConfig& c) { c.payload = PayloadFilterConfig{.ok_relative = 0.0}; });
  names("WrenchConfig force_prior_std", [](PipelineConfig& c) { c.wrench = WrenchConfig{.force_prior_std = 0.0}; });
  names("choose an observer too", [](PipelineConfig& c) { c.observer = std::monostate{}, c.payload = JointFormulaConfig{}; });
  names("choose an observer too", [](PipelineConfig& c) { c.observer = std::monostate{}, c.payload = RegressionConfig{}; });
  names("choose an observer too", [](PipelineConfig& c) { c.observer = std::monostate{}, c.wrench.emplace(); });
}

TEST(Pipeline, AnArmWithoutMassesNeedsAnObserverThatNeedsNone) {
  ArmDescription d;
  d.n = 2;
  const auto arm = std::make_shared<const Arm>(d);
  PipelineConfig c;
  c.observer = ModelResidualConfig{};
  c.payload = std::monostate{};
  EXPECT_NO_THROW(Pipeline(arm, c));
  c.observer = MomentumConfig{};
  EXPECT_THROW(Pipeline(arm, c), std::invalid_argument);
  c.observer = std::monostate{};
  c.payload = PayloadFilterConfig{};
  EXPECT_THROW(Pipeline(arm, c), std::invalid_argument);
}

TEST(Pipeline, PrintsWhatAStepCosts) {  // for the log of the build; nothing is asserted of a machine under load
  const auto arm = make_arm(7);
  const std::vector<RawSample> raw = readings(*arm, 1.0, 0.6, 8);
  using Clock = std::chrono::steady_clock;
  for (const Named& c : combinations()) {
    if (c.name.find("+ none") == std::string::npos && c.name.find("none +") == std::string::npos) continue;
    PipelineConfig config = c.config;
    config.wrench.reset();
    config.contact.reset();
    Pipeline pipeline(arm, config);
    std::vector<double> ns;
    for (const RawSample& r : raw) {
      const auto start = Clock::now();
      (void)pipeline.step(r);
      ns.push_back(std::chrono::duration<double, std::nano>(Clock::now() - start).count());
    }
    std::sort(ns.begin(), ns.end());
    std::printf("%-52s median %7.0f ns, worst %8.0f ns\n", c.name.c_str(), ns[ns.size() / 2], ns.back());
  }
}

}  // namespace
