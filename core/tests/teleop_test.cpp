// Teleoperation: the laws of energy, of links that die and return, of what a hand is shown.
#include "palpate/teleop/episode.hpp"

#include <gtest/gtest.h>

#include <limits>
#include <numbers>

#include "no_alloc.hpp"
#include "test_arms.hpp"

using namespace palpate;
using namespace palpate::teleop;
using palpate_test::Random;

namespace {

constexpr double nan = std::numeric_limits<double>::quiet_NaN();
constexpr double T = 1e-3;

JointVector all(double value) {
  JointVector out{};
  out.fill(value);
  return out;
}
MasterConfig master_config(Coupling coupling = Coupling::force_position) {
  MasterConfig c;
  c.coupling = coupling;
  c.link.ramp = 0.2;
  c.force_limit = all(10.0);
  c.stiffness = all(300.0);
  c.damping = all(5.0);
  c.fill = all(1.0);
  c.hold_stiffness = all(200.0);
  c.hold_damping = all(2.0);
  c.acceleration = all(50.0);
  c.resync_rate = all(150.0);
  return c;
}
SlaveConfig slave_config(Coupling coupling = Coupling::force_position) {
  SlaveConfig c;
  c.coupling = coupling;
  c.link.ramp = 0.2;
  c.lower = all(-0.5);
  c.upper = all(0.5);
  c.speed = all(0.5);
  c.acceleration = all(20.0);
  c.resync_speed = all(0.05);
  c.resync_acceleration = all(0.4);
  c.wall = all(500.0);
  c.force_limit = all(50.0);
  return c;
}

/// Two sides on a line without delay; the slave is where its reference is.
struct Pair {
  MasterSide master;
  SlaveSide slave;
  JointVector at{}, velocity{}, push{};
  MasterCommand felt{};
  SlaveCommand command{};
  int n;
  explicit Pair(int axes, const MasterConfig& m = master_config(), SlaveConfig s = slave_config())
      : master(axes, m), slave(axes, (s.task_space = axes >= 3, s)), n(axes) {
    master.begin(1);
    slave.begin(1);
  }
  void step(const JointVector& x, const JointVector& v, const JointVector& environment = {}, bool line = true, bool closed = true) {
    felt = master.step(x, v, {}, closed, T);
    if (line) slave.receive(master.message());
    command = slave.step(at, velocity, environment, environment, {}, true, T);
    if (line) master.receive(slave.message());
    at = command.position;
    velocity = command.velocity;
  }
};

TEST(TeleopForce, IsNothingBelowTheThresholdAndWholeFromTwiceIt) {
  const FeltForce felt(3.0);
  EXPECT_EQ(felt(2.9, 1.0), 0.0);
  EXPECT_EQ(felt(-3.0, 1.0), 0.0);
  EXPECT_EQ(felt(6.0, 1.0), 6.0);
  EXPECT_EQ(felt(-70.0, 1.0), -70.0);
  EXPECT_EQ(felt(0.1, 0.0), 0.1);
  EXPECT_EQ(felt(nan, 1.0), 0.0);
  EXPECT_EQ(felt(5.0, nan), 0.0);
  double last = 0.0;
  for (int k = 0; k <= 1000; ++k) {  // grows without a step
    const double F = felt(0.01 * k, 1.0);
    EXPECT_GE(F, last);
    EXPECT_LT(F - last, 0.05);
    last = F;
  }
  EXPECT_THROW(FeltForce(-1.0), std::invalid_argument);
}

TEST(TeleopTank, NothingThatTheNetworkDoesMakesEnergy) {
  Random r(3);
  for (int trial = 0; trial < 200; ++trial) {
    TankConfig empty;
    empty.initial = 0.0;
    EnergyTank a(empty), b(empty);
    std::vector<double> way_a, way_b;
    for (int k = 0; k < 500; ++k) {
      for (auto [self, way] : {std::pair{&a, &way_a}, std::pair{&b, &way_b}}) {
        const double work = r(-0.02, 0.02);
        self->exchange(std::max(work, -std::max(0.0, self->level())));
        self->give(r(0.0, 0.3), self->sent() - r(0.0, 0.3), T);
        for (int copies = static_cast<int>(r(0.0, 3.0)); copies > 0; --copies) way->push_back(self->sent());  // lost, once, twice
      }
      for (auto [self, way] : {std::pair{&a, &way_b}, std::pair{&b, &way_a}})
        if (!way->empty() && r(0.0, 1.0) < 0.7) self->receive((*way)[static_cast<std::size_t>(r(0.0, 1.0) * static_cast<double>(way->size()))]);  // in any order
      EXPECT_GE(a.lowest(), 0.0);
      EXPECT_GE(b.lowest(), 0.0);
      EXPECT_LE(a.given() + b.given(), a.taken() + b.taken() + 1e-12);
      EXPECT_LE(a.received(), b.sent() + 1e-12);
    }
  }
}

TEST(TeleopTank, TheLineIsNoStoreHoweverLongItIs) {
  // both take as much as they can for ten seconds; the line delays by half a second, and what it holds stays bounded
  EnergyTank a, b;
  struct Told { double sent, booked, level; };
  std::vector<Told> from_a(500), from_b(500);
  const double most = a.config().most;
  for (std::size_t k = 0; k < 10000; ++k) {
    const Told at_b = from_a[k % 500], at_a = from_b[k % 500];
    a.receive(at_a.sent);
    b.receive(at_b.sent);
    a.exchange(0.01);
    b.exchange(0.01);
    a.give(at_a.level, at_a.booked, T);
    b.give(at_b.level, at_b.booked, T);
    from_a[k % 500] = {a.sent(), a.booked(), a.level()};
    from_b[k % 500] = {b.sent(), b.booked(), b.level()};
    EXPECT_LE(a.level(), most + 1e-12);
    EXPECT_LE(b.level(), most + 1e-12);
    EXPECT_LE(a.sent() - b.received(), most + 1e-12);
    EXPECT_LE(b.sent() - a.received(), most + 1e-12);
  }
  EXPECT_GT(a.received(), 0.1);  // and yet it gives
}

TEST(TeleopTank, ANewSessionGivesNothingThatWasGivenBefore) {
  TankConfig empty;
  empty.initial = 0.0;
  EnergyTank tank(empty);
  tank.begin(5.0);
  tank.receive(5.0);
  EXPECT_EQ(tank.level(), 0.0);
  tank.receive(5.1);
  EXPECT_NEAR(tank.level(), 0.1, 1e-15);
  tank.receive(nan);
  tank.receive(4.0);
  EXPECT_NEAR(tank.level(), 0.1, 1e-15);
}

TEST(TeleopLink, TakesTheNewestOnce) {
  Link link;
  Message m;
  m.session = 2;
  m.sequence = 7;
  EXPECT_TRUE(link.receive(m, 1));
  EXPECT_FALSE(link.receive(m, 1));
  m.sequence = 6;
  EXPECT_FALSE(link.receive(m, 1));
  m.session = 1;
  m.sequence = 100;
  EXPECT_FALSE(link.receive(m, 1));  // of a run that has ended
  m.session = 3;
  m.sequence = 1;
  EXPECT_TRUE(link.receive(m, 1));
  m.sequence = 2;
  m.force[0] = nan;
  EXPECT_FALSE(link.receive(m, 1));
  EXPECT_TRUE(link.receive([&] { m.force[0] = 0.0; return m; }(), 1));
}

TEST(TeleopPair, IsTransparentWithoutDelay) {
  // a spring wall of 2 kN/m, touched slowly: the force of the hand is that of the wall
  MasterConfig mc = master_config();
  mc.force_limit = all(40.0);
  Pair pair(1, mc);
  double x = 0.0, most = 0.0;
  const double wall = 0.05, K = 2e3;
  for (int k = 0; k < 12000; ++k) {
    const double t = k * T, v = t > 1.0 && t < 7.0 ? 0.01 : 0.0;
    x += v * T;
    JointVector F{};
    F[0] = -K * std::max(0.0, pair.at[0] - wall);
    pair.step(all(x), all(v), F);
    if (t > 1.0) {
      most = std::max(most, std::abs(pair.felt.felt[0] - F[0]));
      EXPECT_NEAR(pair.at[0], x, 6e-4);
    }
  }
  EXPECT_NEAR(x, 0.06, 2e-5);
  EXPECT_NEAR(pair.felt.force[0], -K * (x - wall), 0.01 * K * 0.01);  // stiffness felt within 1 %
  EXPECT_LT(most, 0.1);
}

TEST(TeleopPair, ScalesAndTurnsMotionAndForce) {
  SlaveConfig sc = slave_config();
  sc.motion_scale = 2.0;
  sc.force_scale = 0.25;
  sc.rotation = {0, -1, 0, 1, 0, 0, 0, 0, 1};  // slave x = -master y, slave y = master x
  Pair pair(3, master_config(), sc);
  JointVector x{}, v{};
  for (int k = 0; k < 3000; ++k) {
    if (k >= 1000 && k < 2000) x[0] += 2e-5, v[0] = 0.02;
    else v[0] = 0.0;
    JointVector F{};
    if (k > 2000) F[1] = -8.0;
    pair.step(x, v, F);
  }
  EXPECT_NEAR(pair.at[1], 0.04, 1e-4);
  EXPECT_NEAR(pair.at[0], 0.0, 1e-9);
  EXPECT_NEAR(pair.felt.felt[0], -2.0, 1e-9);
  EXPECT_NEAR(pair.felt.felt[1], 0.0, 1e-9);
}

TEST(TeleopPair, TheClutchLetsTheHandGoBack) {
  Pair pair(3);
  double x = 0.0;
  for (int stroke = 0; stroke < 3; ++stroke) {
    for (int k = 0; k < 1500; ++k) {
      const double v = k >= 500 && k < 1500 ? 0.1 : 0.0;
      x += v * T;
      pair.step(all(x), all(v));
    }
    for (int k = 0; k < 500; ++k) {
      x -= 0.2 * T;
      pair.step(all(x), all(-0.2), {}, true, false);
      EXPECT_NE(pair.command.events & event_clutch, 0);
    }
  }
  EXPECT_NEAR(x, 0.0, 1e-9);
  EXPECT_NEAR(pair.at[0], 0.3, 5e-3);
}

TEST(TeleopPair, TheEndOfTheWorkspaceIsFelt) {
  Pair pair(3);
  double x = 0.0;
  for (int k = 0; k < 8000; ++k) {
    const double v = k > 500 && x < 0.51 ? 0.1 : 0.0;
    x += v * T;
    pair.step(all(x), all(v));
    for (std::size_t i = 0; i < 3; ++i) EXPECT_LE(pair.at[i], 0.5 + 1e-12);
  }
  EXPECT_NE(pair.command.events & event_workspace, 0);
  EXPECT_NEAR(pair.felt.felt[0], -500.0 * 0.01, 0.2);
}

TEST(TeleopPair, HoldsWhenTheLinkDiesAndReturnsWithoutAJump) {
  for (const Resync resync : {Resync::index, Resync::approach}) {
    SlaveConfig sc = slave_config();
    sc.resync = resync;
    sc.link.ramp = 1.0;
    MasterConfig mc = master_config();
    mc.link.ramp = 1.0;
    Pair pair(1, mc, sc);
    double x = 0.0, held = 0.0, force = 0.0, speed = 0.0;
    for (int k = 0; k < 9000; ++k) {
      const bool line = k < 2000 || k >= 5000;
      const double v = k < 5000 && k > 500 ? 0.02 : 0.0;
      x += v * T;
      const double touching = resync == Resync::index ? -1e3 * std::max(0.0, pair.at[0] - 0.03) : 0.0;
      const double F = pair.felt.force[0], V = pair.velocity[0];
      pair.step(all(x), all(v), all(touching), line);
      if (k == 2300) held = pair.at[0];
      if (k > 2300 && k < 5000) {
        EXPECT_EQ(pair.at[0], held);
        EXPECT_EQ(pair.felt.status, Status::held);
        EXPECT_NE(pair.command.events & event_link, 0);
      }
      if (k >= 5000) {
        force = std::max(force, std::abs(pair.felt.force[0] - F));
        speed = std::max(speed, std::abs(pair.velocity[0] - V));
        EXPECT_LE(std::abs(pair.velocity[0]), 0.051);
      }
    }
    EXPECT_LT(force, 0.2) << "in one period";
    EXPECT_LT(speed, 5e-3);
    if (resync == Resync::index) EXPECT_NEAR(pair.at[0], held, 2e-3);
    else EXPECT_NEAR(pair.at[0], x, 1e-3);
  }
}

TEST(TeleopPair, BrokenInputIsHeldAndSaid) {
  Pair pair(1);
  for (int k = 0; k < 1000; ++k) pair.step(all(0.01), all(0.0), all(-2.0));
  const JointVector before = pair.at;
  const MasterCommand m = pair.master.step(all(nan), all(0.0), {}, true, T);
  EXPECT_EQ(m.force[0], 0.0);
  EXPECT_EQ(m.status, Status::non_finite);
  EXPECT_NE(m.events & event_input, 0);
  EXPECT_FALSE(pair.master.message().engaged);
  const SlaveCommand s = pair.slave.step(all(nan), {}, {}, {}, {}, true, T);
  EXPECT_EQ(s.position[0], before[0]);
  EXPECT_EQ(s.status, Status::non_finite);
  EXPECT_EQ(pair.slave.step(before, {}, {}, {}, {}, true, -1.0).status, Status::non_finite);
}

TEST(TeleopPair, SaysWhatItExpects) {
  MasterConfig mc = master_config();
  mc.force_limit[0] = -1.0;
  EXPECT_THROW(MasterSide(1, mc), std::invalid_argument);
  SlaveConfig sc = slave_config();
  sc.upper[2] = -1.0;
  EXPECT_THROW(SlaveSide(3, sc), std::invalid_argument);
  EXPECT_THROW(SlaveSide(2, slave_config()), std::invalid_argument);  // task space has three axes
  EXPECT_THROW(SlaveSide(17, slave_config()), std::invalid_argument);
}

TEST(TeleopWaves, AConstantDelayTakesNothingAndMakesNothing) {
  const WaveLine line(20.0);
  Random r(5);
  std::vector<double> there(300, 0.0), back(300, 0.0);
  double energy = 0.0, v = 0.0, F = 0.0;
  for (std::size_t k = 0; k < 20000; ++k) {
    v = 0.99 * v + r(-0.01, 0.01);
    F = 0.99 * F + r(-1.0, 1.0);
    const auto m = line.master(v, back[k % 300]);
    const auto s = line.slave(F, there[k % 300]);
    energy += T * (-m.force * v - F * s.velocity);  // taken from the hand, given to the slave
    EXPECT_GE(energy, -1e-9);
    there[k % 300] = m.wave;
    back[k % 300] = s.wave;
  }
}

void expect_lawful(const EpisodeConfig& c, const EpisodeResult& r, std::uint64_t seed) {
  EXPECT_LE(r.generated, 2.0 * c.tank.initial) << seed;
  EXPECT_GE(r.lowest, 0.0) << seed;
  EXPECT_LE(r.force, c.force_limit * (1.0 + 1e-12)) << seed;
  EXPECT_LE(r.speed, c.speed * (1.0 + 1e-9)) << seed;
  EXPECT_LE(r.force_jump, 2.0) << seed;
  EXPECT_EQ(r.hold_motion, 0.0) << seed;
  EXPECT_TRUE(r.finite) << seed;
}

TEST(TeleopEpisodes, NoEnergyIsMadeAndNoLimitBroken) {
  int shaking = 0;
  for (std::uint64_t seed = 0; seed < 60; ++seed) {
    EpisodeConfig c = random_episode(seed);
    const EpisodeResult r = run_episode(c, seed);
    expect_lawful(c, r, seed);
    c.layer = Layer::none;
    shaking += run_episode(c, seed).generated > 0.1;
  }
  EXPECT_GT(shaking, 20);  // the same without the layer
}

TEST(TeleopEpisodes, AreTheSameEveryTime) {
  const EpisodeConfig c = random_episode(7);
  const EpisodeResult a = run_episode(c, 7), b = run_episode(c, 7);
  EXPECT_EQ(a.generated, b.generated);
  EXPECT_EQ(a.shaking, b.shaking);
  EXPECT_EQ(a.force_jump, b.force_jump);
}

// --- orientation -----------------------------------------------------------------------------------------------------

constexpr double pi = std::numbers::pi;

Mat3<double> matrix(const Vec3<double>& theta) {  // Rodrigues' formula, written down anew
  const double a = std::sqrt(dot(theta, theta));
  if (a == 0.0) return identity3;
  const Vec3<double> e = (1.0 / a) * theta;
  const auto column = [&](const Vec3<double>& u) { return std::cos(a) * u + std::sin(a) * cross(e, u) + (1.0 - std::cos(a)) * dot(e, u) * e; };
  return {column({1, 0, 0}), column({0, 1, 0}), column({0, 0, 1})};
}
/// Angle between two orientations [rad], by their matrices: |R_a - R_b|_F = 2 sqrt(2) sin(angle/2).
double between(const Vec3<double>& a, const Vec3<double>& b) {
  const Mat3<double> A = matrix(a), B = matrix(b);
  const Vec3<double> x = A.cx - B.cx, y = A.cy - B.cy, z = A.cz - B.cz;
  return 2.0 * std::asin(std::min(1.0, std::sqrt((dot(x, x) + dot(y, y) + dot(z, z)) / 8.0)));
}
Vec3<double> direction(Random& r) {
  const Vec3<double> a{r(-1.0, 1.0), r(-1.0, 1.0), r(-1.0, 1.0)};
  return (1.0 / std::sqrt(dot(a, a))) * a;
}
JointVector at(const Vec3<double>& theta) {
  JointVector out{};
  Manifold::put(out, theta);
  return out;
}
Vec3<double> turn(const JointVector& x) { return Manifold::turn(x); }

TEST(TeleopPose, SumsAndDifferencesAreThoseOfRotationMatrices) {
  const Manifold space(6, true);
  Random r(11);
  for (int k = 0; k < 2000; ++k) {
    // every size from none to nearly pi and beyond it
    const Vec3<double> a = r(0.0, 1.0) * pi * direction(r), d = std::pow(10.0, r(-12.0, 0.49)) * direction(r);
    const JointVector sum = space.plus(at(a), at(d));
    const Mat3<double> R = matrix(d) * matrix(a), S = matrix(turn(sum));
    for (const Vec3<double> e : {R.cx - S.cx, R.cy - S.cy, R.cz - S.cz}) EXPECT_LT(dot(e, e), 1e-29);
    const Mat3<double> M = Turn::exp(a).matrix(), A = matrix(a);
    for (const Vec3<double> e : {M.cx - A.cx, M.cy - A.cy, M.cz - A.cz}) EXPECT_LT(dot(e, e), 1e-29);
    const Vec3<double> again = Turn::of(A).log();
    EXPECT_LT(dot(again - a, again - a), 1e-27);
    const Vec3<double> back = turn(space.minus(sum, at(a)));
    EXPECT_LT(std::sqrt(dot(back - d, back - d)), 4e-15 + 1e-14 * std::sqrt(dot(d, d)));
    EXPECT_LE(std::sqrt(dot(turn(sum), turn(sum))), pi + 1e-15);
  }
  EXPECT_EQ(space.minus(at({0.3, -0.2, 0.1}), at({0.3, -0.2, 0.1}))[3], 0.0);
}

TEST(TeleopPose, AVelocityIsTheDifferenceOverTimeNearZeroAndNearPi) {
  // (R(t + h) (-) R(t - h))/2h of a rotation that turns by omega, wherever it is: also where its rotation vector turns over, at pi
  const Manifold space(6, true);
  Random r(12);
  for (const double angle : {0.0, 1e-9, 1e-4, 1.0, pi - 1e-4, pi - 1e-9, pi}) {
    for (int k = 0; k < 50; ++k) {
      const Vec3<double> w = r(0.1, 10.0) * direction(r);
      const JointVector x = at(angle * direction(r));
      const double h = 1e-4;
      const Vec3<double> found = (1.0 / (2.0 * h)) * turn(space.minus(space.plus(x, at(h * w)), space.plus(x, at(-h * w))));
      EXPECT_LT(std::sqrt(dot(found - w, found - w)), 1e-9) << angle;
      // the energy of a spring K |log|^2/2 falls by its torque's work: torque K log, wherever it is not at pi itself
      if (angle == pi || angle == pi - 1e-9) continue;
      const auto energy = [&](double s) {
        const Vec3<double> theta = turn(space.plus(x, at(s * w)));
        return 0.5 * dot(theta, theta);
      };
      const double step = 1e-6;
      EXPECT_NEAR((energy(step) - energy(-step)) / (2.0 * step), dot(turn(x), w), 1e-6 * (1.0 + std::sqrt(dot(w, w)))) << angle;
    }
  }
}

TEST(TeleopPose, TheSlaveTurnsAsTheHandFromWhereItWasEngaged) {
  SlaveConfig sc = slave_config();
  sc.pose = true;
  sc.turn_limit = 3.0;
  sc.rotation = {0, -1, 0, 1, 0, 0, 0, 0, 1};
  sc.speed = all(6.0);
  sc.acceleration = all(200.0);
  MasterConfig mc = master_config();
  mc.pose = true;
  Pair pair(6, mc, sc);
  const Manifold space(6, true);
  pair.at = at({0.4, 0.3, -2.0});  // the slave stands otherwise than the device, and both are far from zero
  JointVector x = at({1.0, -2.0, 0.5});
  const Vec3<double> hand = turn(x), start = turn(pair.at);
  Random r(13);
  double worst = 0.0;
  Vec3<double> w{};
  for (int k = 0; k < 8000; ++k) {
    const double t = k * T;
    w = std::clamp(t - 0.5, 0.0, 1.0) * Vec3<double>{1.5 * std::sin(2.0 * t), 1.2 * std::sin(3.1 * t), 1.3 * std::sin(1.3 * t)};
    JointVector v{};
    Manifold::put(v, w);
    x = space.plus(x, at(T * w));
    pair.step(x, v);
    const Vec3<double> turned = turn(space.minus(x, at(hand)));
    const Vec3<double> wanted = turn(space.plus(at(start), at({-turned.y, turned.x, turned.z})));
    if (t > 0.5) worst = std::max(worst, between(turn(pair.at), wanted));
  }
  EXPECT_LT(worst, 2.3e-3);  // a period at 2.3 rad/s
  for (int k = 0; k < 300; ++k) pair.step(x, {});
  const Vec3<double> turned = turn(space.minus(x, at(hand)));
  EXPECT_GT(std::sqrt(dot(turned, turned)), 0.1);
  EXPECT_LT(between(turn(pair.at), turn(space.plus(at(start), at({-turned.y, turned.x, turned.z})))), 1e-7);
}

TEST(TeleopPose, TheClutchLetsTheHandTurnBackWithoutAJump) {
  SlaveConfig sc = slave_config();
  sc.pose = true;
  sc.turn_limit = 3.0;
  sc.turn_scale = 1.5;
  sc.speed = all(5.0);
  sc.acceleration = all(1e3);
  sc.resync_speed = all(0.5);
  sc.resync_acceleration = all(4.0);
  MasterConfig mc = master_config();
  mc.pose = true;
  Pair pair(6, mc, sc);
  const Manifold space(6, true);
  JointVector x{};
  for (int stroke = 0; stroke < 3; ++stroke) {
    for (int k = 0; k < 2500; ++k) {
      const JointVector before = pair.at;
      const bool turning = k >= 1500 && k < 2100;
      const JointVector v = at({turning ? 0.5 : 0.0, 0.0, 0.0});
      x = space.plus(x, at(T * turn(v)));
      pair.step(x, v);
      const JointVector moved = space.minus(pair.at, before);
      EXPECT_LE(std::abs(moved[3]), 0.9 * T);  // 0.5 rad/s times 1.5, and never a jump
    }
    const JointVector held = pair.at;
    for (int k = 0; k < 500; ++k) {
      const JointVector v = at({-0.6, 0.4, 0.0});
      x = space.plus(x, at(T * turn(v)));
      pair.step(x, v, {}, true, false);
      EXPECT_EQ(pair.at, held);
    }
    for (int k = 0; k < 500; ++k) {
      x = space.plus(x, at({0.0, -0.4 * T, 0.0}));
      pair.step(x, {}, {}, true, false);
    }
  }
  EXPECT_NEAR(pair.at[3], 3.0 * 1.5 * 0.3, 0.02);
  EXPECT_NEAR(pair.at[4], 0.0, 1e-6);
}

TEST(TeleopPose, TheLargestAngleIsHeldAndFeltAndPointingBeyondPiDoesNotTurnItRound) {
  SlaveConfig sc = slave_config();
  sc.pose = true;
  sc.turn_limit = 1.0;
  sc.speed = all(2.0);
  sc.wall = all(5.0);
  MasterConfig mc = master_config();
  mc.pose = true;
  Pair pair(6, mc, sc);
  const Manifold space(6, true);
  JointVector x{};
  const Vec3<double> axis = {0.6, 0.0, 0.8};
  double most = 0.0, torque = 0.0;
  for (int k = 0; k < 6000; ++k) {
    const JointVector v = at((k > 500 && k < 5000 ? 1.0 : 0.0) * axis);  // 4.5 rad in all: beyond pi
    const Vec3<double> before = turn(pair.at);
    x = space.plus(x, at(T * turn(v)));
    pair.step(x, v);
    const Vec3<double> now = turn(pair.at);
    most = std::max(most, std::sqrt(dot(now, now)));
    EXPECT_GE(dot(now - before, axis), -1e-9) << k;  // it never turns back or round
    if (k == 1800) torque = dot(turn(pair.felt.felt), axis);
  }
  EXPECT_NEAR(most, 1.0, 1e-9);
  EXPECT_NEAR(torque, -5.0 * 0.3, 0.05);
  EXPECT_NE(pair.command.events & event_workspace, 0);
  // it is left at once where the hand turns back by what did not slip, half the way from there to pi
  for (int k = 0; k < 1300; ++k) {
    const JointVector v = at(-1.0 * axis);
    x = space.plus(x, at(T * turn(v)));
    pair.step(x, v);
  }
  EXPECT_EQ(pair.command.events & event_workspace, 0);
  EXPECT_LT(std::sqrt(dot(turn(pair.at), turn(pair.at))), 0.9);
}

TEST(TeleopPose, TorqueIsFeltByItsOwnThresholdAndScaleAndNotWhereThereIsNoMotor) {
  SlaveConfig sc = slave_config();
  sc.pose = true;
  sc.motion_scale = 2.0;
  sc.force_scale = 0.5;
  sc.turn_scale = 1.0;
  for (const bool motor : {true, false}) {
    MasterConfig mc = master_config();
    mc.pose = true;
    for (std::size_t i = 3; i < 6; ++i) mc.force_limit[i] = motor ? 0.4 : 0.0;
    MasterSide master(6, mc);
    SlaveSide slave(6, sc);
    master.begin(1);
    slave.begin(1);
    JointVector wrench{}, std{};
    wrench[0] = -4.0, wrench[3] = -0.9, wrench[4] = 0.9;
    std[0] = 0.1, std[3] = 0.1, std[4] = 0.5;
    MasterCommand felt;
    for (int k = 0; k < 1500; ++k) {
      felt = master.step({}, {}, {}, true, T);
      slave.receive(master.message());
      slave.step({}, {}, wrench, wrench, std, true, T);
      master.receive(slave.message());
    }
    EXPECT_NEAR(felt.felt[0], -2.0, 1e-9);
    EXPECT_NEAR(felt.felt[3], motor ? -0.9 * 0.5 * 1.0 / 2.0 : 0.0, 1e-9);  // a force at a lever that is scaled like the motion
    EXPECT_EQ(felt.felt[4], 0.0);                                           // within its own threshold
    EXPECT_EQ(felt.events & event_force, 0);                                // no motor is no limit reached
    EXPECT_EQ(master.message().shown & 0x3F, motor ? 0x3F : 0x07);
  }
}

TEST(TeleopPose, WhatShowsNoTorqueAsksNoTank) {
  // a spring of 2 N m/rad is turned by a whole radian: nobody pays by a gimbal that only measures, and yet it goes
  for (const bool motor : {true, false}) {
    SlaveConfig sc = slave_config();
    sc.pose = true;
    sc.speed = all(3.0);
    MasterConfig mc = master_config();
    mc.pose = true;
    for (std::size_t i = 3; i < 6; ++i) mc.force_limit[i] = motor ? 0.05 : 0.0;
    Pair pair(6, mc, sc);
    const Manifold space(6, true);
    JointVector x{};
    for (int k = 0; k < 4000; ++k) {
      const JointVector v = at({0.0, 0.0, k > 1000 && k < 2000 ? 1.0 : 0.0});
      x = space.plus(x, at(T * turn(v)));
      pair.step(x, v, at({0.0, 0.0, -2.0 * pair.at[5]}));
    }
    if (motor) EXPECT_LT(pair.at[5], 0.5);  // the hand gave 0.05 J, and no more comes out
    else EXPECT_NEAR(pair.at[5], x[5], 1e-6);
    EXPECT_GE(pair.slave.tank().lowest(), 0.0);
  }
}

TEST(TeleopPose, HoldsWhenTheLinkDiesAndReturnsWithoutAJump) {
  SlaveConfig sc = slave_config();
  sc.pose = true;
  sc.speed = all(5.0);
  sc.resync_speed = all(0.5);
  sc.resync_acceleration = all(2.0);
  sc.link.ramp = 1.0;
  MasterConfig mc = master_config();
  mc.pose = true;
  mc.link.ramp = 1.0;
  for (std::size_t i = 3; i < 6; ++i) mc.force_limit[i] = 1.0, mc.hold_stiffness[i] = 2.0, mc.hold_damping[i] = 0.02, mc.resync_rate[i] = 15.0;
  Pair pair(6, mc, sc);
  const Manifold space(6, true);
  JointVector x{}, held{};
  double torque = 0.0, speed = 0.0;
  for (int k = 0; k < 9000; ++k) {
    const bool line = k < 2000 || k >= 5000;
    const JointVector v = at({k < 5000 && k > 500 ? 0.1 : 0.0, k < 5000 && k > 500 ? 0.15 : 0.0, 0.0});
    x = space.plus(x, at(T * turn(v)));
    const double touching = -2.0 * std::max(0.0, pair.at[3] - 0.1);
    const double before = pair.felt.force[3], w = pair.velocity[4];
    pair.step(x, v, at({touching, 0.0, 0.0}), line);
    if (k == 2300) held = pair.at;
    if (k > 2300 && k < 5000) {
      EXPECT_EQ(pair.at, held);
      EXPECT_NE(pair.command.events & event_link, 0);
      if (k > 3500) EXPECT_LT(pair.felt.force[3], -0.05);  // the device is held where the link died
    }
    if (k >= 5000) {
      torque = std::max(torque, std::abs(pair.felt.force[3] - before));
      speed = std::max(speed, std::abs(pair.velocity[4] - w));
    }
  }
  EXPECT_LT(torque, 0.02) << "in one period";
  EXPECT_LT(speed, 0.05);
  EXPECT_LT(between(turn(pair.at), turn(held)), 0.02);
}

TEST(TeleopPose, SaysWhatItExpects) {
  SlaveConfig sc = slave_config();
  sc.pose = true;
  EXPECT_THROW(SlaveSide(5, sc), std::invalid_argument);
  EXPECT_NO_THROW(SlaveSide(6, sc));
  sc.turn_limit = 3.2;
  EXPECT_THROW(SlaveSide(6, sc), std::invalid_argument);
  sc.turn_limit = 1.0;
  sc.turn_scale = 2.0;
  sc.resync = Resync::approach;
  EXPECT_THROW(SlaveSide(6, sc), std::invalid_argument);
  sc.turn_scale = 1.0;
  sc.task_space = false;
  EXPECT_THROW(SlaveSide(6, sc), std::invalid_argument);
  MasterConfig mc = master_config();
  mc.pose = true;
  EXPECT_THROW(MasterSide(3, mc), std::invalid_argument);
}

TEST(TeleopEpisodes, OfAPoseMakeNoEnergyAndBreakNoLimit) {
  int shaking = 0;
  for (std::uint64_t seed = 0; seed < 20; ++seed) {
    EpisodeConfig c = random_episode(seed);
    c.pose = true;
    const EpisodeResult r = run_episode(c, seed);
    expect_lawful(c, r, seed);
    if (seed >= 6) continue;
    c.layer = Layer::none;
    shaking += run_episode(c, seed).generated > 0.1;
  }
  EXPECT_GT(shaking, 2);  // the same without the layer
}

TEST(TeleopPair, AStepAllocatesNothing) {
  MasterConfig mc = master_config(Coupling::four_channel);
  SlaveConfig sc = slave_config(Coupling::four_channel);
  mc.pose = sc.pose = true;
  Pair pair(6, mc, sc);
  palpate::test::AllocationCounter counter;
  for (int k = 0; k < 100; ++k) pair.step(all(1e-4 * k), all(0.1), all(-1.0));
  EXPECT_EQ(counter.count(), 0u);
}

}  // namespace
