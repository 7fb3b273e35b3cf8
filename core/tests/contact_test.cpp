// Contact detection: the stated rate is kept, contacts are found soon, on the right link, and reversals are none.
#include "palpate/contact.hpp"

#include <gtest/gtest.h>

#include <functional>
#include <vector>

#include "no_alloc.hpp"
#include "test_arms.hpp"

using namespace palpate;
using palpate_test::Random;

namespace {

constexpr std::size_t at(int i) { return static_cast<std::size_t>(i); }

ArmDescription description(int n) {
  Random r(21);
  ArmDescription d = palpate_test::random_description(r, n);
  for (int j = 0; j < n; ++j) {
    d.joints[at(j)].prismatic = false;
    d.joints[at(j)].rotor_inertia = 0.2;
    d.joints[at(j)].friction = {.coulomb = 2.0, .viscous = 1.0, .sign_velocity = 0.02};
    d.joints[at(j)].torque_std = 0.1;
    d.joints[at(j)].velocity_std = 2e-4;
  }
  return d;
}

/// A run of an arm that moves as asked, by inverse dynamics exact for the detector's discretisation; truth beside it.
struct Scene {
  double rate = 1000.0;
  double amplitude = 0.3;                 ///< of the swing [rad]
  double speed = 1.0;                     ///< of the swing [rad/s of phase]
  double center = 2.0;                    ///< steady velocity under the swing: no reversals if large [rad/s of phase amplitude]
  double noise = 1.0;                     ///< on torque and velocity, in their stated standard deviations
  double error_std = 0.0, error_time = 1.0;  ///< slow model error of each joint [N m], [s]
  double friction_error = 0.0;            ///< true Coulomb friction is that much larger, and a true sign [1]
  std::uint64_t seed = 1;
  std::function<JointVector(double t, const JointVector& q)> push{};  ///< tau_ext [N m]
};

class Source {
 public:
  Source(const Arm& arm, const Scene& scene) : arm_(arm), scene_(scene), random_(scene.seed) {}
  JointSample next() {
    const int n = arm_.n();
    const double h = 1.0 / scene_.rate, t = k_ * h;
    JointSample s;
    s.time_ns = std::llround(t * 1e9);
    s.dt = k_ > 0 ? h : 0.0;
    s.status = Status::ok;
    s.velocity_measured = true;
    JointVector dq{};
    for (int j = 0; j < n; ++j) {
      const double w = scene_.speed * (1.0 + 0.13 * j);
      s.q[at(j)] = scene_.center * t * scene_.amplitude + scene_.amplitude * std::sin(w * t + j);
      dq[at(j)] = scene_.center * scene_.amplitude + scene_.amplitude * w * std::cos(w * t + j);
    }
    const MomentumTerms<double> m = momentum_terms<double>(arm_, s.q, dq);
    const JointVector push = scene_.push ? scene_.push(t, s.q) : JointVector{};
    JointVector beta{};
    const double phi = std::exp(-h / scene_.error_time);
    for (int j = 0; j < n; ++j) {
      const auto u = at(j);
      const Friction& f = arm_.joint(j).friction;
      double friction = f.torque(dq[u]);
      if (scene_.friction_error != 0.0) friction = f.viscous * dq[u] + (dq[u] >= 0.0 ? 1.0 : -1.0) * (1.0 + scene_.friction_error) * f.coulomb;
      beta[u] = m.Ct_dq[u] - m.g[u] - friction;
      error_[u] = phi * error_[u] + std::sqrt(1.0 - phi * phi) * scene_.error_std * random_.normal();
      s.tau[u] = (m.p[u] - p_[u]) / h - 0.5 * (beta[u] + beta_[u]) - push[u] - error_[u] + scene_.noise * arm_.joint(j).torque_std * random_.normal();
      s.dq_std[u] = arm_.joint(j).velocity_std;
      s.dq[u] = dq[u] + scene_.noise * s.dq_std[u] * random_.normal();
    }
    p_ = m.p;
    beta_ = beta;
    ++k_;
    return s;
  }
  double time() const { return (k_ - 1) / scene_.rate; }

 private:
  Arm arm_;
  Scene scene_;
  Random random_;
  JointVector p_{}, beta_{}, error_{};
  int k_ = 0;
};

JointVector all(double x) {
  JointVector v;
  v.fill(x);
  return v;
}
/// J^T F for a force at the middle of a link.
JointVector force_on(const Arm& arm, int link, const JointVector& q, const Vec3<double>& F) {
  const Pose<double> P = forward_kinematics<double>(arm, q);
  const Vec3<double> to = link + 1 < arm.n() ? P.origin[at(link + 1)] : P.p + P.R * arm.p_last_grasp();
  const Vec3<double> x = P.origin[at(link)] + 0.5 * (to - P.origin[at(link)]);
  JointVector tau{};
  for (int j = 0; j <= link; ++j) tau[at(j)] = dot(jacobian_column(arm, P, j, x), F);
  return tau;
}

TEST(Contact, SiegmundsThresholdGivesTheTimeBetweenAlarms) {
  Random r(1);
  for (double kappa : ContactDetector::drifts) {
    const double arl = 2000.0, h = ContactDetector::threshold(kappa, arl);
    double samples = 0.0;
    const int alarms = 2000;
    for (int k = 0; k < alarms; ++k)
      for (double g = 0.0; g <= h; samples += 1.0) g = std::max(0.0, g + r.normal() - kappa);
    EXPECT_GT(samples / alarms, 0.85 * arl) << kappa;  // never more alarms than stated, but for the approximation
    EXPECT_LT(samples / alarms, 1.6 * arl) << kappa;
  }
}

TEST(Contact, InnovationsAreWhiteWhereTheErrorsAreAsStated) {
  const Arm arm(description(4));
  const Scene scene{.error_std = 0.8, .error_time = 1.0};
  Source source(arm, scene);
  ContactDetector detector(arm, {.model_std = all(0.8), .model_time = 1.0, .friction_fraction = 0.0});
  const LoadTorque load(arm);
  double mean = 0.0, square = 0.0, next = 0.0, last = 0.0;
  const int count = 60000;
  for (int k = 0; k < count; ++k) {
    (void)detector.step(source.next(), load);
    if (k < 1000) continue;
    const double e = detector.innovation(1);
    mean += e / count, square += e * e / count, next += e * last / count;
    last = e;
  }
  EXPECT_NEAR(mean, 0.0, 0.02);
  EXPECT_NEAR(square, 1.0, 0.05);
  EXPECT_NEAR(next, 0.0, 0.03);
}

TEST(Contact, TheStatedRateOfFalseAlarmsIsKept) {
  const Arm arm(description(3));
  for (double rate : {1000.0, 100.0}) {
    const double per_hour = rate * 3600.0 / 4000.0;  // one in 4000 samples
    Source source(arm, {.rate = rate, .error_std = 0.8, .error_time = 1.0});
    ContactDetector detector(arm, {.false_alarms_per_hour = per_hour, .model_std = all(0.8), .model_time = 1.0, .friction_fraction = 0.0});
    const LoadTorque load(arm);
    Contact seen;
    double tested = 0.0;
    for (int k = 0; k < 600000; ++k) {
      seen = detector.step(source.next(), load);
      tested += seen.active ? 0.0 : 1.0;
    }
    const double stated = tested / 4000.0;
    EXPECT_LT(seen.count, 1.1 * stated) << rate;
    EXPECT_GT(seen.count, 0.15 * stated) << rate;  // sums of one joint alarm together: fewer than stated, not far fewer
  }
}

struct Found {
  Contact first{};
  std::uint32_t count = 0;
  std::int64_t released_ns = 0;
};
Found detect(const Arm& arm, const Scene& scene, const ContactConfig& config, double seconds) {
  Source source(arm, scene);
  ContactDetector detector(arm, config);
  const LoadTorque load(arm);
  Found out;
  for (int k = 0; k < seconds * scene.rate; ++k) {
    const Contact c = detector.step(source.next(), load);
    if (c.active && c.count == 1) out.first = c;
    out.count = c.count;
    out.released_ns = c.release_time_ns;
  }
  return out;
}

TEST(Contact, AHardContactIsFoundWithinMilliseconds) {
  const Arm arm(description(6));
  int judged = 0;
  for (int link = 0; link < 6; ++link) {
    Scene scene{.seed = 3u + static_cast<unsigned>(link)};
    scene.push = [&](double t, const JointVector& q) {  // 1000 N within 10 ms, for 0.2 s
      const double rise = std::clamp((t - 2.0) / 0.01, 0.0, 1.0);
      return t < 2.0 || t > 2.2 ? JointVector{} : force_on(arm, link, q, {600.0 * rise, -500.0 * rise, 620.0 * rise});
    };
    const Found found = detect(arm, scene, {}, 3.0);
    const JointVector felt = scene.push(2.1, Source(arm, scene).next().q);
    if (std::abs(felt[at(link)]) < 30.0) continue;  // too near the axis to be a hard contact of this joint
    ++judged;
    ASSERT_EQ(found.count, 1u) << link;
    const double onset = static_cast<double>(found.first.onset_time_ns) * 1e-9, alarm = static_cast<double>(found.first.alarm_time_ns) * 1e-9;
    EXPECT_LE(alarm - 2.0, 0.005 + 1e-9) << link;
    EXPECT_NEAR(onset, 2.0, 0.004) << link;
    EXPECT_LE(found.first.link, link);
    EXPECT_GE(found.first.farthest, link);
    EXPECT_NEAR(static_cast<double>(found.released_ns) * 1e-9, 2.2, 0.15) << link;
  }
  EXPECT_GE(judged, 4);
}

TEST(Contact, ASoftContactIsFoundBeforeItIsHard) {
  const Arm arm(description(6));
  Scene scene{};
  scene.push = [&](double t, const JointVector& q) {  // 100 N/s
    const double F = std::clamp(100.0 * (t - 2.0), 0.0, 60.0);
    return force_on(arm, 5, q, {0.6 * F, -0.5 * F, 0.62 * F});
  };
  ContactConfig config{.friction_fraction = 0.02};
  const Found found = detect(arm, scene, config, 3.0);
  ASSERT_EQ(found.count, 1u);
  EXPECT_LE(static_cast<double>(found.first.alarm_time_ns) * 1e-9, 2.05);
  EXPECT_NEAR(static_cast<double>(found.first.onset_time_ns) * 1e-9, 2.01, 0.03);
  EXPECT_EQ(found.released_ns, 0);  // it lasts
}

TEST(Contact, EndsForAJointTooThatFeltItLate) {  // its model's error had taken the push: let go is no new contact
  const Arm arm(description(3));
  Scene scene{.error_std = 0.05};
  scene.push = [](double t, const JointVector&) { return t > 2.0 && t < 2.5 ? JointVector{12.0, 5.0, 0.0} : JointVector{}; };
  for (double slow : {0.3, 1.0, 3.0}) {
    const Found found = detect(arm, scene, {.model_std = {0.1, slow, 0.1}, .friction_fraction = 0.0}, 4.0);
    EXPECT_EQ(found.count, 1u) << slow;
    EXPECT_NEAR(static_cast<double>(found.released_ns) * 1e-9, 2.5, 0.15) << slow;
  }
}

TEST(Contact, ReversalsAreNone) {
  const Arm arm(description(4));
  for (double error : {0.0, 0.3, -0.3})  // true dry friction, a third off, where the model has a smooth sign
    for (double speed : {0.3, 1.0, 3.0}) {
      const Found found = detect(arm, {.speed = speed, .center = 0.0, .friction_error = error == 0.0 ? 1e-9 : error}, {}, 30.0);
      EXPECT_EQ(found.count, 0u) << error << " " << speed << " link " << found.first.link << " at " << found.first.onset_time_ns << " to " << found.first.alarm_time_ns;
    }
}

TEST(Contact, BreakingAwayFromRestIsNone) {  // the drive loads its gear up to the stiction, then the joint moves
  const Arm arm(description(2));
  ContactDetector detector(arm);
  const LoadTorque load(arm);
  Contact seen;
  for (int k = 0; k < 4000; ++k) {
    JointSample s;
    s.time_ns = k * 1000000ll;
    s.dt = k > 0 ? 1e-3 : 0.0;
    s.dq_std = {1e-4, 1e-4};
    s.velocity_measured = true;
    s.status = Status::ok;
    const auto m = momentum_terms<double>(arm, s.q, s.dq);
    for (int j = 0; j < 2; ++j) s.tau[at(j)] = m.g[at(j)] + 1.9 * std::clamp((k - 1000) / 50.0, -1.0, 1.0);  // from -F to +F in 0.1 s
    seen = detector.step(s, load);
  }
  EXPECT_EQ(seen.count, 0u);
}

TEST(Contact, ARareSlowErrorOfACreepingJointIsNone) {  // beyond stiction and two of its deviations, as it is in 1 of 20 draws
  const Arm arm(description(2));
  for (double deviations : {2.5, 3.5, 4.5}) {
    ContactDetector detector(arm, {.model_std = all(0.8), .model_time = 1.0});
    const LoadTorque load(arm);
    Random noise(3);
    Contact seen;
    for (int k = 0; k < 8000; ++k) {
      JointSample s;
      s.time_ns = k * 1000000ll;
      s.dt = k > 0 ? 1e-3 : 0.0;
      s.velocity_measured = true;
      s.status = Status::ok;
      s.dq_std = {2e-4, 2e-4};
      for (int j = 0; j < 2; ++j) s.dq[at(j)] = 3e-3, s.q[at(j)] = 3e-6 * k;  // it moves for certain, where the model says half at rest
      const auto m = momentum_terms<double>(arm, s.q, s.dq);
      const double slow = 0.8 * deviations * std::sin(1.5e-3 * k);  // as fast as such an error may be
      for (int j = 0; j < 2; ++j) s.tau[at(j)] = m.g[at(j)] + arm.joint(j).friction.viscous * 3e-3 + 1.3 * 2.0 * std::min(k / 1000.0, 1.0) + slow + 0.1 * noise.normal();
      seen = detector.step(s, load);
    }
    EXPECT_EQ(seen.count, 0u) << deviations;
  }
}

TEST(Contact, ASlowPushAtRestIsFoundOnceItOutdoesStiction) {
  ArmDescription d = description(2);
  for (int j : {0, 1}) d.joints[at(j)].velocity_std = 2e-3;  // noise of the velocity hides who turned the sign
  const Arm arm(d);
  const double F = 1.3 * 2.0, rise = 10.0;  // stiction that may be [N m], of the push [N m/s]
  for (double loaded : {-2.0, 0.0, 2.0}) {
    ContactDetector detector(arm);
    const LoadTorque load(arm);
    Random noise(7);
    for (int k = 0; k < 3000; ++k) {
      JointSample s;
      s.time_ns = k * 1000000ll;
      s.dt = k > 0 ? 1e-3 : 0.0;
      s.velocity_measured = true;
      s.status = Status::ok;
      const double push = rise * std::max(0.0, 1e-3 * (k - 1000));
      const auto m = momentum_terms<double>(arm, s.q, JointVector{});
      for (int j = 0; j < 2; ++j) {
        s.dq_std[at(j)] = 2e-3;
        s.dq[at(j)] = 2e-3 * noise.normal();
        s.tau[at(j)] = m.g[at(j)] + loaded - (j == 0 ? push : 0.0) + 0.1 * noise.normal();
      }
      const Contact seen = detector.step(s, load);
      const double borne = std::abs(loaded - push);
      if (borne <= F) {
        ASSERT_EQ(seen.count, 0u) << loaded << ", " << k;
      } else if (borne > 2.5 * F) {
        ASSERT_TRUE(seen.active) << loaded << ", " << k;
      }
      if (seen.count > 0) {
        EXPECT_EQ(seen.count, 1u) << "one push, one contact";
        EXPECT_EQ(seen.link, 0);
        EXPECT_NEAR(static_cast<double>(seen.onset_time_ns) * 1e-9, 1.0, 0.15) << "where the push began, not where it outdid stiction";
      }
    }
  }
}

TEST(Contact, NoiseOfTheVelocityHidesNoPushWhereFrictionRemembers) {  // its sign goes with the travel
  ArmDescription d = description(2);
  for (auto& joint : d.joints) {
    joint.velocity_std = 2e-3;
    joint.friction.sign_velocity = 1e-3;
    joint.friction.presliding = 1e-4;
  }
  const Arm arm(d);
  ContactDetector detector(arm);
  FrictionMemory memory;
  const LoadTorque load(arm);
  Random noise(7);
  Contact seen;
  for (int k = 0; k < 1650; ++k) {  // until the push outdoes stiction, 2.6 N m, 2.5 times
    JointSample s;
    s.time_ns = k * 1000000ll;
    s.dt = k > 0 ? 1e-3 : 0.0;
    s.velocity_measured = true;
    s.status = Status::ok;
    const double push = 10.0 * std::max(0.0, 1e-3 * (k - 1000));
    const auto m = momentum_terms<double>(arm, s.q, JointVector{});
    for (int j = 0; j < 2; ++j) {
      s.dq_std[at(j)] = 2e-3;
      s.dq[at(j)] = 2e-3 * noise.normal();
      s.tau[at(j)] = m.g[at(j)] - (j == 0 ? push : 0.0) + 0.1 * noise.normal();
    }
    memory.step(arm, s);
    seen = detector.step(s, load);
    if (push <= 2.6) ASSERT_EQ(seen.count, 0u) << k;
  }
  EXPECT_TRUE(seen.active);
  EXPECT_EQ(seen.link, 0);
  EXPECT_NEAR(static_cast<double>(seen.onset_time_ns) * 1e-9, 1.0, 0.15);
}

TEST(Contact, ALoadThatIsKnownIsNone) {
  ArmDescription d = description(4);
  const Arm arm(d);
  const double mass = 3.0;
  for (bool known : {true, false}) {
    LoadTorque load(arm, {.mass = known ? mass : 0.0, .acceleration_time = 0.0});
    Scene scene{};
    Source source(arm, scene);
    ContactDetector detector(arm, {.friction_fraction = 0.05});
    Contact seen;
    const Inertia<double> body = about_origin(mass, arm.p_last_grasp(), Sym3<double>{});
    for (int k = 0; k < 3000; ++k) {
      JointSample s = source.next();
      const auto bare = momentum_terms<double>(arm, s.q, s.dq), loaded = momentum_terms<double>(arm, s.q, s.dq, body);
      load.step(s, {});
      for (int j = 0; j < 4; ++j) s.tau[at(j)] += k > 1500 ? loaded.g[at(j)] - bare.g[at(j)] : 0.0;  // weight alone: slow motion
      if (known && k <= 1500) continue;
      seen = detector.step(s, load);
    }
    if (known) EXPECT_EQ(seen.count, 0u);
    else EXPECT_GE(seen.count, 1u);
  }
}

TEST(Contact, TheTipIsToldFromALinkBeforeIt) {
  const Arm arm(description(6));
  Scene tip{}, link{};
  tip.push = [&](double t, const JointVector& q) {
    const Pose<double> P = forward_kinematics<double>(arm, q);
    JointVector tau{};
    for (int j = 0; t > 2.0 && j < 6; ++j) tau[at(j)] = dot(jacobian_column(arm, P, j, P.p + P.R * arm.p_last_grasp()), {30.0, 40.0, -35.0});
    return tau;
  };
  link.push = [&](double t, const JointVector& q) { return t > 2.0 ? force_on(arm, 2, q, {80.0, 90.0, -75.0}) : JointVector{}; };
  const Found at_tip = detect(arm, tip, {}, 2.5), on_link = detect(arm, link, {}, 2.5);
  EXPECT_TRUE(at_tip.first.tip);
  EXPECT_EQ(at_tip.first.farthest, 5);
  EXPECT_LE(on_link.first.link, 2);
  EXPECT_GE(on_link.first.farthest, 2);
  EXPECT_FALSE(on_link.first.tip);
}

TEST(Contact, FromTheControllersOwnModel) {
  ArmDescription d = description(3);
  for (auto& joint : d.joints) joint.mass = 0.0;
  const Arm arm(d);
  EXPECT_THROW(ContactDetector{arm}, std::invalid_argument);  // no masses
  ContactDetector detector(arm, {.source = ContactSource::model_residual});
  const LoadTorque load(arm);
  Random r(7);
  Contact seen;
  for (int k = 0; k < 4000; ++k) {
    JointSample s;
    s.time_ns = k * 2000000ll;
    s.dt = k > 0 ? 2e-3 : 0.0;
    s.dq = {0.3, 0.3, 0.3};
    s.status = Status::ok;
    s.has_model_torque = k % 100 != 50;
    for (int j = 0; j < 3; ++j) {
      s.model_torque[at(j)] = 5.0 * std::sin(0.01 * k);
      s.tau[at(j)] = s.model_torque[at(j)] + 0.1 * r.normal() - (j < 2 && k > 3000 && k < 3300 ? 15.0 : 0.0);
    }
    seen = detector.step(s, load);
    if (k == 50) EXPECT_EQ(seen.status, Status::held);
    if (k == 3100) EXPECT_EQ(seen.link, 1);
    if (k == 3100) EXPECT_NEAR(seen.torque[0], 15.0, 1.0);
  }
  EXPECT_EQ(seen.count, 1u);
  EXPECT_FALSE(seen.active);
  EXPECT_NEAR(static_cast<double>(seen.onset_time_ns) * 1e-9, 6.002, 0.003);
  EXPECT_NEAR(static_cast<double>(seen.release_time_ns) * 1e-9, 6.6, 0.1);
}

TEST(Contact, OneBadSampleIsNone) {
  const Arm arm(description(3));
  Source source(arm, {});
  ContactDetector detector(arm);
  const LoadTorque load(arm);
  Contact seen;
  for (int k = 0; k < 5000; ++k) {
    JointSample s = source.next();
    if (k % 500 == 400) s.tau[1] += 100.0;
    seen = detector.step(s, load);
  }
  EXPECT_EQ(seen.count, 0u);
}

TEST(Contact, GapsAndRefusedSamples) {
  const Arm arm(description(3));
  Source source(arm, {});
  ContactDetector detector(arm);
  const LoadTorque load(arm);
  for (int k = 0; k < 2000; ++k) {
    JointSample s = source.next();
    if (k == 0) EXPECT_EQ(detector.step(s, load).status, Status::warming);
    else if (k == 1000) {
      s.status = Status::gap;
      EXPECT_EQ(detector.step(s, load).status, Status::gap);
    } else {
      const Contact c = detector.step(s, load);
      if (k > 300 && k < 1000) EXPECT_EQ(c.status, Status::ok);
      if (k > 1000 && k < 1100) EXPECT_EQ(c.status, Status::warming);
    }
    s.status = Status::non_finite;
    s.tau[0] = std::nan("");
    EXPECT_EQ(detector.step(s, load).status, Status::held);
  }
  EXPECT_EQ(detector.step(source.next(), load).count, 0u);
}

TEST(Contact, ResetIsNewAndNothingIsAllocated) {
  const Arm arm(description(7));
  Scene scene{};
  scene.push = [](double t, const JointVector&) { return t > 0.5 && t < 0.8 ? all(30.0) : JointVector{}; };
  Source source(arm, scene);
  std::vector<JointSample> samples;
  for (int k = 0; k < 1500; ++k) samples.push_back(source.next());
  const LoadTorque load(arm);
  ContactDetector fresh(arm), used(arm);
  for (const JointSample& s : samples) (void)used.step(s, load);
  used.reset();
  const palpate::test::AllocationCounter counter;
  std::uint32_t count = 0;
  bool same = true;
  for (const JointSample& s : samples) {
    const Contact a = fresh.step(s, load), b = used.step(s, load);
    same = same && a.torque == b.torque && a.level == b.level && a.active == b.active && a.onset_time_ns == b.onset_time_ns;
    count = a.count;
  }
  EXPECT_EQ(counter.count(), 0u);
  EXPECT_TRUE(same);
  EXPECT_EQ(count, 1u);
}

TEST(Contact, RefusesWhatCannotWork) {
  const Arm arm(description(3));
  EXPECT_THROW(ContactDetector(arm, {.false_alarms_per_hour = 0.0}), std::invalid_argument);
  EXPECT_THROW(ContactDetector(arm, {.noise_std = {-1.0}}), std::invalid_argument);
  EXPECT_THROW(ContactDetector(arm, {.model_time = 0.0}), std::invalid_argument);
  EXPECT_THROW(ContactDetector(arm, {.clip = -1.0}), std::invalid_argument);
}

}  // namespace
