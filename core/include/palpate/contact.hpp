// Contact: a sequential test per joint with a stated false-alarm rate, the link that is touched, onset and release.
#pragma once
#include <algorithm>
#include <limits>
#include <numbers>

#include "palpate/wrench.hpp"

namespace palpate {

/// Where the detector takes its residual from.
enum class ContactSource : std::uint8_t {
  momentum = 0,        ///< generalised momentum and the arm's own model
  model_residual = 1,  ///< the controller's bare-arm torque and the friction, less the measured torque; needs no masses
};

struct ContactConfig {
  double false_alarms_per_hour = 1e-3;  ///< of the whole arm, while its errors are what is stated below [1/h]
  ContactSource source = ContactSource::momentum;
  JointVector noise_std{};         ///< white error of the torque per sample, beside the arm's own [N m]
  JointVector model_std{};         ///< slow error of the model in motion, beside the friction's [N m]
  double model_time = 1.0;         ///< how long such an error lasts, and the friction's, in motion [s]
  double friction_fraction = 0.3;  ///< error of the friction model in motion, part of Coulomb friction [1]
  double rest_time = 0.03;         ///< how fast friction wanders within +-F while a joint rests [s]
  double settle_time = 0.05;       ///< how long friction takes to settle after rest or a reversal [s]
  double clip = 6.0;               ///< a sample counts for no more, so that one bad sample is no contact [standard deviations]
  double contact_time = 0.02;      ///< time constant of the contact torque that is reported [s]
  double release_time = 0.1;       ///< so long nothing must be felt until the contact has ended [s]
  double warm_up = 0.2;            ///< after a start or a gap no test is made for so long [s]
};

/// Page's two-sided CUSUM on whitened innovations, one per joint (MATH.md section 5).
///
/// Untouched, a joint obeys  p' = tau + C^T q' - g - tau_f + tau_L + b + w,  z = p + noise of q' seen through M, where b is what
/// the model gets wrong: not white, but a process whose size and correlation time depend on the motion,
///   V = rho ((1 + friction_fraction) F)^2/3 + (1 - rho) (friction_fraction F_c)^2 + model_std^2 + (torque_gain_std tau)^2 + Var(tau_L)_j,
///   1/T = rho/rest_time + (1 - rho)/model_time,      rho = max(1 - tanh^2(q'/v_0), what it was, fading with settle_time):
/// slow and small in motion; at rest anything within stiction +-F, and quick, as a drive may load its gear at any time without
/// moving it; and so for a moment after rest, until friction has settled. Within +-sqrt(3 V), at rest stiction and two deviations
/// of the slow errors, b walks at random, 2 V/T per second (to any place at once while the direction of motion is not sure), and
/// may stay where it is; beyond it stiction drives it no further, and it returns: within model_time while the joint creeps, for
/// then it is a rare slow error; within rest_time while it may stand still, for then the model's errors do too; or a contact
/// has brought it there. A turn of the sign renews it (SignTravel). So reversals, starts and stops are no contacts.
/// A Kalman filter of two states per joint, (p, b), takes all that is expected out of z; what is left, e = innovation/std, is
/// white with variance 1 as long as nothing touches the arm. Then for kappa = 1/4, 1/2, 1, 2, from soft contacts to hard ones,
///   g+ <- max(0, g+ + e - kappa),  g- <- max(0, g- - e - kappa),  alarm at g > h(kappa).
/// The thresholds follow from the rate by Siegmund's approximation of the mean time between false alarms of one sum,
///   ARL = (exp(x) - x - 1)/(2 kappa^2) samples,  x = 2 kappa (h + 1.166),   ARL = 10 n 3600/(rate dt),
/// n joints with eight sums each, and two for the test that follows, which share the rate; contact_test.cpp counts alarms.
/// With model_residual, z = tau_model + tau_f - tau = b + w. Where friction remembers (FrictionHistory), stiction lies around
/// what it remembers, +-F.
/// While a joint rests the filter follows whatever stiction may do, and with the noise it would follow a slow push beyond it
/// too. So there what acts, low-passed with contact_time, is also held against stiction itself: alarm at
///   (|b - center| - F)/std > x,   P(N(0, 1) > x) = 1/ARL,   std of the low-passed noise and the slow errors,
/// of a joint that surely rests (rho > 0.9), once it has been within (what is there at a start, or stays after a contact, is a
/// load); that contact lasts while it is > 3.
///
/// The onset is when the alarmed sum last left zero; of a joint at rest, when what acts left the level it had had for a while: a
/// push shows in the motor long before it outdoes stiction, but so may stiction. From then on b of an alarmed joint is kept and what the joint feels beyond
/// it is the contact's torque c, until it has been within three standard deviations, or stiction, for release_time.
/// A contact on link k is felt by joints 1..k only: `link` is the last joint that feels it, by alarm and by
///   |c_j| > 3 std_j + f sum_i |M_ji/M_ii c_i|   for contact_time,   f = 1/5 + 4/5 exp(-time since the alarm/(5 contact_time)):
/// a hit shakes its neighbours through the inertia, and what the model misses of that, most in the first moment, is no contact.
/// A push across a joint's
/// axis is not felt by it, so the link touched may be a later one: up to `farthest` a force somewhere between the link's
/// joints, or 3 cm beside, explains all joints; `tip`: one at the grasp point does.
class ContactDetector {
 public:
  explicit ContactDetector(const Arm& arm, const ContactConfig& config = {}) : arm_(&arm), config_(config) {
    if (config.source == ContactSource::momentum && !arm.has_dynamics())
      throw std::invalid_argument("ContactDetector: the arm has no masses; give inertials, or take source model_residual");
    check::positive("ContactConfig false_alarms_per_hour [1/h]", config.false_alarms_per_hour);
    for (int j = 0; j < arm.n(); ++j) {
      check::not_negative(check::entry("ContactConfig noise_std", u(j), "N m"), config.noise_std[u(j)]);
      check::not_negative(check::entry("ContactConfig model_std", u(j), "N m"), config.model_std[u(j)]);
    }
    check::positive("ContactConfig model_time [s]", config.model_time);
    check::not_negative("ContactConfig friction_fraction [1]", config.friction_fraction);
    check::positive("ContactConfig rest_time [s]", config.rest_time);
    check::positive("ContactConfig settle_time [s]", config.settle_time);
    check::positive("ContactConfig clip [1]", config.clip);
    check::positive("ContactConfig contact_time [s]", config.contact_time);
    check::not_negative("ContactConfig release_time [s]", config.release_time);
    check::not_negative("ContactConfig warm_up [s]", config.warm_up);
  }

  /// Threshold h for a mean time of `samples` between false alarms of one one-sided sum with drift kappa (Siegmund 1985).
  static double threshold(double kappa, double samples) noexcept {
    // The approximation is for small kappa; simulated, its time is short by 6 % at kappa = 1 and by 20 % at 2.
    const double wanted = samples * (1.0 + kappa * kappa / 16.0);
    double x = 1.0;
    for (int k = 0; k < 60; ++k) x = std::log(1.0 + x + 2.0 * kappa * kappa * wanted);
    return std::max(x / (2.0 * kappa) - 1.166, 0.0);
  }

  /// x with P(N(0, 1) > x) = p, for 0 < p < 0.5.
  static double upper_point(double p) noexcept {
    double low = 0.0, high = 40.0;
    for (int k = 0; k < 60; ++k) {
      const double x = 0.5 * (low + high);
      (0.5 * std::erfc(x / std::numbers::sqrt2) > p ? low : high) = x;
    }
    return high;
  }

  /// A sample, and the torque of the load that is held.
  Contact step(const JointSample& s, const LoadTorque& load) noexcept {
    if (s.status == Status::non_finite || s.status == Status::time_error) return report(Status::held);
    if (config_.source == ContactSource::model_residual && !s.has_model_torque) return report(Status::held);
    Measurement m = measure(s, load);
    if (!known_ || s.status != Status::ok || !(s.dt > 0.0)) {
      begin(s, load, m);
      return report(s.status == Status::ok ? Status::warming : s.status);
    }
    update_threshold(s.dt);
    decay_.of(s.dt, config_);
    elapsed_ += s.dt;
    for (int j = 0; j < arm_->n(); ++j) follow(j, s, load, m);
    beta_ = m.beta;
    tau_ = s.tau;
    judge(s);
    last_ns_ = s.time_ns;
    return report(elapsed_ < config_.warm_up ? Status::warming : Status::ok);
  }

  void reset() { *this = ContactDetector(*arm_, config_); }

  /// kappa of the sums that run side by side: half the shift of the mean each is quickest for [standard deviations].
  static constexpr std::array<double, 4> drifts{0.25, 0.5, 1.0, 2.0};

  /// Whitened innovation of a joint in the last sample: standard normal while nothing touches the arm (for tests).
  double innovation(int j) const noexcept { return joints_[u(j)].e; }
  /// Thresholds h in force, one per drift [1].
  const std::array<double, 4>& thresholds() const noexcept { return h_; }

 private:
  struct Sum {
    double g = 0.0;
    std::int64_t since_ns = 0;  // when it last left zero
    double b = 0.0;             // and what b was then
  };
  struct JointState {
    double p = 0.0, b = 0.0;                     // momentum [N m s], model error [N m]
    double P_pp = 0.0, P_pb = 0.0, P_bb = 0.0;
    double e = 0.0;                              // whitened innovation
    std::array<Sum, 8> sums{};                   // g+ and g- of every drift
    double z = 0.0;                              // last measurement
    double fast = 0.0, fast_variance = 0.0;      // low-passed one-step torque, and its noise
    double base = 0.0;                           // b at the onset of the contact: what is no contact
    double wandered = 0.0, renewed = 0.0;        // variance of base: as known then and what wandered since; by turns of the sign
    double bound = 0.0, center = 0.0;            // sqrt(3 V); b at rest lies within center +- bound
    bool feels = false, unsure = true;           // unsure of the direction of motion
    double rest = 0.0, dq = 0.0, dry = 0.0;      // rho; q' of the last sample, and the dry friction it gives
    double felt = 0.0;                           // how long the joint has felt this contact [s]
    SignTravel travel{};
    double steady = 0.0, beyond = 0.0;           // what acts off center, clipped and low-passed [N m]; how far beyond stiction at rest [std]
    bool armed = false, held = false;            // it was within stiction; it alarmed by being beyond, and is still
    std::int64_t within_ns = 0;                  // when it last was
    double level = 0.0;                          // steady, as it has been for a while [N m]
    std::int64_t level_ns = 0;                   // when steady was last there
    bool rested = false;                         // and the joint rested then

    /// The part of b that the model's errors may be.
    double stiction(double x) const noexcept { return std::clamp(x, center - bound, center + bound); }
  };
  /// What fades within a sample; exponentials cost as much as all else, and most periods are equal.
  struct Decay {
    double dt = 0.0, settle = 0.0, still = 0.0, back = 0.0, slow = 0.0, quick = 0.0, contact = 0.0, level = 0.0;
    void of(double h, const ContactConfig& c) noexcept {
      if (h == dt) return;
      dt = h;
      settle = std::exp(-h / c.settle_time);
      still = -std::expm1(-h / c.rest_time);
      back = -std::expm1(-h / c.model_time);
      slow = -std::expm1(-2.0 * h / c.model_time);
      quick = -std::expm1(-2.0 * h / c.rest_time);
      contact = -std::expm1(-h / c.contact_time);
      level = -std::expm1(-h / (10.0 * c.contact_time));
    }
  };
  struct Measurement {
    JointVector z{}, input{}, beta{}, variance{}, slope{};  // variance of z
  };
  static constexpr std::size_t u(int i) noexcept { return static_cast<std::size_t>(i); }
  static constexpr double square(double x) noexcept { return x * x; }

  Measurement measure(const JointSample& s, const LoadTorque& load) noexcept {
    Measurement m;
    const int n = arm_->n();
    if (config_.source == ContactSource::model_residual) {
      for (int j = 0; j < n; ++j) m.z[u(j)] = s.model_torque[u(j)] + arm_->joint(j).friction.torque(s.dq[u(j)]) - s.tau[u(j)] - load.torque()[u(j)];
      return m;
    }
    const MomentumTerms<double> t = momentum_terms<double>(*arm_, s.q, s.dq);
    bool moved = !known_;
    for (int j = 0; j < n; ++j) moved = moved || std::abs(s.q[u(j)] - M_at_[u(j)]) > 0.1;
    if (moved) {
      M_ = mass_matrix<double>(*arm_, s.q);
      M_at_ = s.q;
    }
    for (int j = 0; j < n; ++j) {
      const Friction& friction = arm_->joint(j).friction;
      m.z[u(j)] = t.p[u(j)];
      m.beta[u(j)] = t.Ct_dq[u(j)] - t.g[u(j)] - friction.torque(s.dq[u(j)]) + load.torque()[u(j)];
      // A differentiated velocity is that of half a step ago, and so must be the torque.
      m.input[u(j)] = s.velocity_measured ? s.tau[u(j)] : 0.5 * (s.tau[u(j)] + tau_[u(j)]);
      m.slope[u(j)] = friction.derivative(s.dq[u(j)]);
      if (friction.presliding > 0.0) {  // its sign goes with the travel, not with the noise of dq
        const double sign = std::tanh(s.dq[u(j)] / friction.sign_velocity);
        m.slope[u(j)] -= friction.level(s.dq[u(j)]) * (1.0 - sign * sign) / friction.sign_velocity;
      }
      double sum = 0.0;
      for (int k = 0; k < n; ++k) sum += square(M_(j, k) * std::max(s.dq_std[u(k)], 1e-7));
      m.variance[u(j)] = sum;
    }
    return m;
  }

  /// Variance of the model error b at this joint now [N^2 m^2].
  double model_variance(int j, const JointSample& s, const LoadTorque& load, double rest) const noexcept {
    const JointDescription& d = arm_->joint(j);
    constexpr double fast = 1e3;  // in units of v_0: motion for certain
    return rest * rest_variance(j, s) + (1.0 - rest) * square(d.friction.uncertainty(fast * d.friction.sign_velocity, config_.friction_fraction, s.tau[u(j)])) +
           square(config_.model_std[u(j)]) + square(d.torque_gain_std * s.tau[u(j)]) + square(load.std(j)) + 1e-18;
  }
  double rest_variance(int j, const JointSample& s) const noexcept {
    return square((1.0 + config_.friction_fraction) * arm_->joint(j).friction.uncertainty(0.0, config_.friction_fraction, s.tau[u(j)]));
  }
  double white_variance(int j) const noexcept { return arm_->torque_variance(j) + square(config_.noise_std[u(j)]) + 1e-18; }

  void begin(const JointSample& s, const LoadTorque& load, const Measurement& m) noexcept {
    for (int j = 0; j < arm_->n(); ++j) {
      JointState& J = joints_[u(j)];
      const SignTravel travel = J.travel;
      const double b = s.status == Status::gap ? 0.0 : J.b;
      J = JointState{};
      J.travel = travel;
      J.b = b;
      J.z = J.p = m.z[u(j)];
      J.P_pp = m.variance[u(j)];
      J.rest = 1.0;
      J.P_bb = 1e4 * (model_variance(j, s, load, 1.0) + white_variance(j));  // what is there at the start is no contact
    }
    beta_ = m.beta;
    tau_ = s.tau;
    elapsed_ = 0.0;
    contact_.active = false;
    contact_.link = contact_.farthest = -1;
    contact_.tip = false;
    last_ns_ = s.time_ns;
    known_ = s.status == Status::ok;
  }

  void update_threshold(double dt) noexcept {
    mean_dt_ = mean_dt_ > 0.0 ? mean_dt_ + 0.02 * (dt - mean_dt_) : dt;
    if (std::abs(mean_dt_ - threshold_dt_) <= 0.02 * threshold_dt_) return;
    threshold_dt_ = mean_dt_;
    const double samples = static_cast<double>(2 * drifts.size() + 2) * arm_->n() * 3600.0 / (config_.false_alarms_per_hour * mean_dt_);
    for (std::size_t k = 0; k < drifts.size(); ++k) h_[k] = threshold(drifts[k], samples);
    most_beyond_ = upper_point(1.0 / samples);
  }

  void follow(int j, const JointSample& s, const LoadTorque& load, const Measurement& m) noexcept {
    JointState& J = joints_[u(j)];
    const double h = s.dt, z = m.z[u(j)], R = m.variance[u(j)];
    const Friction& friction = arm_->joint(j).friction;
    const bool momentum = config_.source == ContactSource::momentum;
    // While its direction is not sure, or has just turned, friction may be at either bound from one sample to the next.
    const bool unsure = std::abs(s.dq[u(j)]) <= 3.0 * s.dq_std[u(j)] || s.dq[u(j)] * J.dq < 0.0;
    const bool undirected = unsure || J.unsure;  // beta is a mean over two samples
    J.unsure = unsure;
    J.dq = s.dq[u(j)];
    // What friction was loaded with at rest wears off with time, and no sooner than over the travel in which it turns over.
    const double kept = friction.presliding > 0.0 ? std::exp(-h * std::abs(s.dq[u(j)]) / friction.presliding) : 0.0;
    J.rest = std::max(undirected ? 1.0 : 1.0 - square(std::tanh(s.dq[u(j)] / friction.sign_velocity)), J.rest * std::max(decay_.settle, kept));
    const double V = model_variance(j, s, load, J.rest), V_rest = J.rest * rest_variance(j, s);
    const double turned = J.travel.step(friction, s.dq[u(j)], s.dq_std[u(j)]) * rest_variance(j, s);
    const double slow = (V - V_rest) * decay_.slow;
    const double quick = undirected ? 4.0 * V_rest : V_rest * decay_.quick;
    J.bound = (1.0 - J.rest) * std::sqrt(3.0 * V) + J.rest * (std::sqrt(3.0 * V_rest) + 2.0 * std::sqrt(V - V_rest));
    const double dry = friction.level(s.dq[u(j)]) * std::tanh(s.dq[u(j)] / friction.sign_velocity);
    J.center = J.rest * (0.5 * (dry + J.dry) + s.friction_excess[u(j)]);  // the model's own, whatever noise of dq makes of either
    J.dry = dry;
    const double white = white_variance(j) + 0.5 * square(m.slope[u(j)] * s.dq_std[u(j)]);
    const double input = m.input[u(j)] + 0.5 * (m.beta[u(j)] + beta_[u(j)]);

    // What acted in this step alone, and its low-pass: the contact's torque when there is one.
    const double now = momentum ? (z - J.z) / h - input : z;
    const double a = decay_.contact;
    J.fast += (elapsed_ > h ? a : 1.0) * (now - J.fast);
    J.fast_variance = a / (2.0 - a) * white + (momentum ? 2.0 * square(a / h) / (2.0 - a) * R : 0.0);
    J.z = z;
    const double most = config_.clip * std::sqrt(white + (momentum ? 2.0 * R / (h * h) : 0.0));
    const double moved = now - J.center - J.steady;
    J.steady += elapsed_ < config_.warm_up ? (elapsed_ > h ? a : 1.0) * moved : a * std::clamp(moved, -most, most);
    J.beyond = J.rest > 0.9 ? std::max(0.0, std::abs(J.steady) - std::sqrt(3.0 * V_rest)) / std::sqrt(J.fast_variance + V - V_rest) : 0.0;
    if (elapsed_ < config_.warm_up || std::abs(J.steady - J.level) < 3.0 * std::sqrt(J.fast_variance)) J.level_ns = s.time_ns, J.rested = J.rest > 0.5;
    J.level += (elapsed_ < config_.warm_up ? 1.0 : decay_.level) * (J.steady - J.level);
    if (J.beyond < 3.0) J.held = false;
    if (J.beyond < 1.0) J.armed = elapsed_ >= config_.warm_up, J.within_ns = last_ns_;

    // Prediction and update of (p, b), or of b alone. Friction at rest is quick up to the bound, not beyond it.
    const double b_before = J.b;
    J.b -= (undirected ? decay_.still : decay_.back) * (J.b - J.stiction(J.b));
    if (momentum) J.p += h * (input + b_before);
    const double y = momentum ? z - J.p : z - J.b;
    const double off = J.b - J.center;
    const double wander = slow + turned + quick * (y * off > 0.0 ? std::max(0.0, 1.0 - square(off / J.bound)) : 1.0);
    double S, K_b;
    if (momentum) {
      J.P_pp += h * (2.0 * J.P_pb + h * J.P_bb) + h * h * white;
      J.P_pb += h * J.P_bb;
      J.P_bb += wander;
      S = J.P_pp + R;
      K_b = J.P_pb / S;
      J.p += J.P_pp / S * y;
      J.P_bb = std::max(J.P_bb - K_b * J.P_pb, 0.0);
      J.P_pb *= R / S;
      J.P_pp *= R / S;
    } else {
      J.P_bb += wander;
      S = J.P_bb + white;
      K_b = J.P_bb / S;
      J.P_bb *= white / S;
    }
    const double std = std::sqrt(S);
    J.e = y / std;
    const double e = std::clamp(J.e, -config_.clip, config_.clip);
    if (momentum && std::abs(J.e) > config_.clip) {  // an impulse is past with its sample: it counts once
      J.p = z;
      J.P_pp = R;
      J.P_pb = 0.0;
    }
    if (contact_.active) {
      J.wandered = std::min(J.wandered + slow, std::max(J.wandered, V - V_rest));
      J.renewed = std::min(J.renewed + turned, rest_variance(j, s));
    }
    if (J.feels) {
      J.b = J.base;  // kept while the contact lasts
      return;
    }
    J.b += K_b * (elapsed_ < config_.warm_up ? y : e * std);
    if (elapsed_ < config_.warm_up) return;
    for (std::size_t k = 0; k < J.sums.size(); ++k) {
      Sum& sum = J.sums[k];
      if (sum.g == 0.0) sum.since_ns = last_ns_, sum.b = b_before;
      sum.g = std::max(0.0, sum.g + (k % 2 == 0 ? e : -e) - drifts[k / 2]);
    }
  }

  void judge(const JointSample& s) noexcept {
    const int n = arm_->n();
    bool alarm = false;
    std::int64_t onset = std::numeric_limits<std::int64_t>::max();
    for (int j = 0; j < n; ++j) {
      JointState& J = joints_[u(j)];
      if (J.feels) continue;
      const Sum* first = nullptr;
      for (std::size_t k = 0; k < J.sums.size(); ++k)  // of those that alarm the latest start is the sharpest
        if (J.sums[k].g > h_[k / 2] && (first == nullptr || J.sums[k].since_ns > first->since_ns)) first = &J.sums[k];
      J.held = first == nullptr && J.armed && J.beyond > most_beyond_;
      if (first == nullptr && !J.held) continue;
      J.feels = alarm = true;
      if (!contact_.active) J.base = J.held ? J.center : J.rest > 0.5 ? J.stiction(first->b) : first->b;
      onset = std::min(onset, J.held ? J.within_ns : first->since_ns);
      if (J.rested) onset = std::min(onset, J.level_ns);
    }
    if (alarm && !contact_.active) {
      contact_.active = true;
      ++contact_.count;
      contact_.onset_time_ns = onset;
      contact_.alarm_time_ns = s.time_ns;
      for (int j = 0; j < n; ++j) {  // a joint that feels it later has taken some of it for its model's error by then
        JointState& J = joints_[u(j)];
        if (!J.feels) J.base = J.b;
        J.wandered = J.P_bb;
        J.renewed = 0.0;
      }
    }
    if (!contact_.active) return;
    bool quiet = true;
    int last = -1, alarmed = -1;
    const double age = static_cast<double>(s.time_ns - contact_.alarm_time_ns) * 1e-9;
    const double fraction = 0.2 + 0.8 * std::exp(-age / (5.0 * config_.contact_time));
    JointVector c{};
    for (int j = 0; j < n; ++j) c[u(j)] = felt_torque(joints_[u(j)]);
    for (int j = 0; j < n; ++j) {
      JointState& J = joints_[u(j)];
      if (!J.feels) continue;
      const double std = std::sqrt(J.fast_variance + J.wandered + J.renewed);
      // Of a joint at rest anything within the bound may be stiction.
      const double stiction = J.rest > 0.5 ? J.fast - J.stiction(J.fast) : c[u(j)];
      quiet = quiet && !J.held && std::min(std::abs(c[u(j)]) - 3.0 * std, std::abs(stiction) - 3.0 * std::sqrt(J.fast_variance)) < 0.0;
      double shaken = 0.0;
      for (int i = 0; i < n; ++i)
        if (i != j && config_.source == ContactSource::momentum) shaken += fraction * std::abs(M_(j, i) / M_(i, i) * c[u(i)]);
      if (std::abs(c[u(j)]) > 3.0 * std + shaken) J.felt += s.dt;
      if (J.felt >= config_.contact_time) last = j;
      if (alarmed < 0 || std::abs(c[u(j)]) > std::abs(c[u(alarmed)])) alarmed = j;
    }
    contact_.link = last >= 0 ? last : alarmed;
    reach(s.q, c);
    if (!quiet || alarm) {
      felt_ns_ = s.time_ns;
    } else if (static_cast<double>(s.time_ns - felt_ns_) * 1e-9 >= config_.release_time) {
      contact_.active = false;
      contact_.release_time_ns = felt_ns_;
      contact_.link = contact_.farthest = -1;
      contact_.tip = false;
      for (int j = 0; j < n; ++j) {  // a new start from what is there now
        JointState& J = joints_[u(j)];
        J.b = J.fast;
        J.P_bb += J.fast_variance + J.wandered + J.renewed;
        J.P_pb = 0.0;
        J.sums = {};
        J.feels = J.armed = J.held = false;
        J.felt = 0.0;
      }
    }
  }

  /// Torque of the contact at a joint: beyond what was there at its onset [N m].
  static double felt_torque(const JointState& J) noexcept { return J.fast - (J.feels ? J.base : J.b); }

  /// The farthest link on which one force explains what the joints feel, and whether one at the grasp point does.
  void reach(const JointVector& q, const JointVector& c) noexcept {
    const int n = arm_->n();
    const Pose<double> P = forward_kinematics<double>(*arm_, q);
    const Vec3<double> grasp = P.p + P.R * arm_->p_last_grasp();
    contact_.tip = explains(P, n - 1, grasp, c);
    contact_.farthest = contact_.tip ? n - 1 : contact_.link;
    for (int k = n - 1; k > contact_.farthest; --k) {
      const Vec3<double> from = P.origin[u(k)], to = k + 1 < n ? P.origin[u(k + 1)] : grasp;
      for (double part : {0.0, 0.5, 1.0})
        if (explains(P, k, from + part * (to - from), c)) {
          contact_.farthest = k;
          return;
        }
    }
  }

  /// Chi-square test of c = J^T F for a force F at x on a link; F is fitted, x may be 3 cm off.
  bool explains(const Pose<double>& P, int link, const Vec3<double>& x, const JointVector& c) const noexcept {
    const int n = arm_->n();
    std::array<Vec3<double>, max_joints> J{};
    JointVector variance{};
    for (int j = 0; j < n; ++j) {
      const JointState& S = joints_[u(j)];
      if (j <= link) J[u(j)] = jacobian_column(*arm_, P, j, x);
      variance[u(j)] = S.fast_variance + S.wandered + S.renewed + S.P_bb + 1e-12;
    }
    Vec3<double> F{};
    double left = 0.0;
    for (int pass = 0; pass < 2; ++pass) {  // the second one knows the size of the force, hence what 3 cm off the point do
      const auto weight = [&](int j) {
        return 1.0 / (variance[u(j)] + (j <= link && !arm_->body(j).prismatic ? 9e-4 * dot(F, F) : 0.0));
      };
      JointMatrix A{};
      JointVector b{};
      for (int j = 0; j < n; ++j) {
        const double w = weight(j);
        const std::array<double, 3> r{J[u(j)].x, J[u(j)].y, J[u(j)].z};
        for (int k = 0; k < 3; ++k) {
          for (int l = 0; l < 3; ++l) A(k, l) += w * r[u(k)] * r[u(l)];
          b[u(k)] += w * r[u(k)] * c[u(j)];
        }
      }
      for (int k = 0; k < 3; ++k) A(k, k) += 1e-6;  // forces of a thousand newtons: what no joint feels is taken as zero
      const JointVector f = Cholesky<double>(A, 3).solve(b);
      const Vec3<double> fitted{f[0], f[1], f[2]};
      left = 0.0;
      for (int j = 0; j < n; ++j) left += weight(j) * square(c[u(j)] - dot(J[u(j)], fitted));
      F = fitted;
    }
    // 99.9 % point of chi-square (Wilson, Hilferty).
    const double k = std::max(1, n - 3), z = 3.09, t = 1.0 - 2.0 / (9.0 * k) + z * std::sqrt(2.0 / (9.0 * k));
    return left < k * t * t * t;
  }

  Contact report(Status status) noexcept {
    contact_.status = status;
    for (int j = 0; j < arm_->n(); ++j) {
      const JointState& J = joints_[u(j)];
      contact_.torque[u(j)] = contact_.active ? felt_torque(J) : 0.0;
      contact_.std[u(j)] = std::sqrt(J.fast_variance + J.wandered + J.renewed + J.P_bb);
      double level = J.feels ? 1.0 : 0.0;
      for (std::size_t k = 0; !J.feels && k < J.sums.size(); ++k) level = std::max(level, h_[k / 2] > 0.0 ? J.sums[k].g / h_[k / 2] : 0.0);
      if (!J.feels && J.armed && most_beyond_ > 0.0) level = std::max(level, J.beyond / most_beyond_);
      contact_.level[u(j)] = level;
    }
    return contact_;
  }

  const Arm* arm_;
  ContactConfig config_;
  std::array<JointState, max_joints> joints_{};
  Contact contact_{};
  JointMatrix M_{};
  JointVector M_at_{}, beta_{}, tau_{};
  double mean_dt_ = 0.0, threshold_dt_ = 0.0, elapsed_ = 0.0;
  double most_beyond_ = 0.0;
  Decay decay_{};
  std::array<double, 4> h_{};
  std::int64_t last_ns_ = 0, felt_ns_ = 0;
  bool known_ = false;
};

}  // namespace palpate
