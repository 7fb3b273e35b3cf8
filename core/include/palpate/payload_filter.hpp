// Payload Kalman filter: the mass of what is held, and where it is held, from positions and torques, at rest and in motion.
#pragma once
#include <algorithm>

#include "palpate/check.hpp"
#include "palpate/kalman.hpp"
#include "palpate/payload.hpp"

namespace palpate {

struct PayloadFilterConfig {
  bool first_moment = false;         ///< estimate m and m (c - grasp); else m alone, held exactly at the grasp point
  double mass_prior_std = std::numeric_limits<double>::quiet_NaN();  ///< of the mass before anything is known, about 0 [kg];
                                     ///< NaN: what the arm's torque limits let it hold stretched out, 5 kg if it has none
  double offset_prior_std = 0.05;    ///< of the grasp point's error, each tip axis [m]
  double velocity_prior_std = 1.0;   ///< of q' at the start [rad/s]
  double model_torque_std = 0.0;     ///< error of the arm's model, white per sample, beside the drives' own [N m]
  double friction_fraction = 0.3;    ///< error of the friction model in motion, part of Coulomb friction [1]
  double friction_time = 5.0;        ///< how long such an error lasts [s]
  double change_threshold = 7.0;     ///< a load change is declared at so many standard deviations [1]; infinity: never
  double min_change = 0.01;          ///< smaller changes of mass are not declared [kg]
  double max_step = 0.02;            ///< longer intervals are predicted in several steps [s]
  double ok_relative = 0.05;         ///< status `ok` once mass_std is below the larger of this part of the mass
  double ok_absolute = 0.01;         ///< and this [kg]
};

/// State (q, q', theta, b) with
///   M(q; theta) q'' + C q' + g + tau_f = tau + b,   z = q + encoder rounding
/// theta = m, or (m, m delta) with delta = c - grasp the offset of the load's centre of mass, in tip axes; b the slowly
/// varying error of the friction model, one per joint that has Coulomb friction. (MATH.md section 4; kalman.hpp.)
///
/// The torque is linear in m and m delta but for m |delta|^2. (In m and delta it is not: a load that hangs still says
/// m delta = 0, from which a filter on delta would conclude that m is small.)
/// What bounds the first moment is |delta|, not the mass that the arm could hold: its prior follows what is known of the mass,
/// standard deviation offset_prior_std (|m| + 2 std(m)). With first_moment the load's own inertia, which is not in the state, is
/// taken to be up to that of a radius of gyration of 2 offset_prior_std.
/// b is a first-order process of standard deviation Friction::uncertainty (wide at rest, where stiction hides any torque
/// within +-F_c) and time friction_time; a start, a stop and a reversal draw it anew.
///
/// Grasp and release: twelve hypotheses "the mass jumped s seconds ago" run beside the filter (Willsky, Jones 1976). Each
/// propagates the error e that a unit jump would leave and correlates it with the innovations y of variance S:
///   jump = sum(e y/S) / I,   significance = |sum(e y/S)| / sqrt(I)  [standard deviations],   I = sum(e^2/S) + 1/mass_prior_std^2.
/// The prior keeps a joint that hardly feels the load from explaining its own breakaway by a load that no arm could hold.
/// The winner's e, times the prior, is added to the covariance, so that the new load is learnt as the first one was. Until the
/// mass has been known for a while it corrects the first guess and is not counted as a change.
///
/// The interval that is reported counts, beside the filter's, how far the estimate has moved of late: one that linearisation
/// still drags along is not known as well as its variance says.
class PayloadFilter {
 public:
  static constexpr int max_parameters = 4 + 2 * max_joints;
  using Filter = JointKalman<max_parameters>;

  explicit PayloadFilter(const Arm& arm, const PayloadFilterConfig& config = {})
      : arm_(&arm),
        config_(config),
        loads_(config.first_moment ? 4 : 1),
        biases_(has_coulomb(arm) ? arm.n() : 0),
        initial_prior_std_(std::isnan(config.mass_prior_std) ? holdable_mass(arm) : config.mass_prior_std),
        filter_(arm.n(), loads_, biases_ > 0, has_rounding(arm)),
        unit_(detail::load_basis(arm)) {
    if (!arm.has_dynamics()) throw std::invalid_argument("PayloadFilter: the arm has no masses; give inertials");
    check::positive("PayloadFilterConfig mass_prior_std [kg]", initial_prior_std_);
    check::positive("PayloadFilterConfig offset_prior_std [m]", config.offset_prior_std);
    check::positive("PayloadFilterConfig velocity_prior_std [rad/s]", config.velocity_prior_std);
    check::not_negative("PayloadFilterConfig model_torque_std [N m]", config.model_torque_std);
    check::not_negative("PayloadFilterConfig friction_fraction [1]", config.friction_fraction);
    check::positive("PayloadFilterConfig friction_time [s]", config.friction_time);
    check::positive_or_infinite("PayloadFilterConfig change_threshold [std]", config.change_threshold);
    check::not_negative("PayloadFilterConfig min_change [kg]", config.min_change);
    check::positive("PayloadFilterConfig max_step [s]", config.max_step);
    check::positive("PayloadFilterConfig ok_relative [1]", config.ok_relative);
    check::positive("PayloadFilterConfig ok_absolute [kg]", config.ok_absolute);
    for (int i = 0; i < arm.n(); ++i)
      torque_variance_[u(i)] = arm.torque_variance(i) + config.model_torque_std * config.model_torque_std;
    decay_.fill(1.0);
    forget_everything();
    restart_hypotheses();
  }

  Payload step(const JointSample& s) noexcept {
    if (s.status == Status::non_finite || s.status == Status::time_error) return report(s, Status::held);
    tau_ = s.tau;
    if (!started_ || s.status == Status::gap || !(s.dt > 0.0)) {
      if (started_) forget_load();  // it may have been put down meanwhile
      begin(s);
      return report(s, s.status == Status::gap ? Status::gap : Status::warming);
    }
    const int steps = 1 + static_cast<int>(s.dt / config_.max_step);
    for (int k = 0; k < steps; ++k) predict(s, s.dt / steps);
    look_for_breakaway(s);
    const double smoothing = -std::expm1(-s.dt / memory), quick = -std::expm1(-s.dt / 0.03);
    JointVector dq{}, ddq{};  // corrections of (q, q')
    double correction = 0.0, correction_variance = 0.0;  // of the mass
    filter_.measure_joints(*arm_, s, [&](int i, int e, const Filter::Update& update) {
      if (i < arm_->n()) {
        const double square = std::min(update.y * update.y / update.s, 100.0);
        surprise_[u(i)] += smoothing * (square - surprise_[u(i)]);
        recent_surprise_[u(i)] += quick * (square - recent_surprise_[u(i)]);
      }
      const double of_mass = update.K[2 * arm_->n()];
      correction += of_mass * update.y;
      correction_variance += of_mass * of_mass * update.s;
      for (int j = 0; j < arm_->n(); ++j) {
        dq[u(j)] += update.K[j] * update.y;
        ddq[u(j)] += update.K[arm_->n() + j] * update.y;
      }
      for (Hypothesis& hyp : hypotheses_) {
        const double seen = hyp.e[u(i)] + (e >= 0 ? hyp.e[u(e)] : 0.0);
        hyp.num += seen * update.y / update.s;
        hyp.den += seen * seen / update.s;
        for (int r = 0; r < filter_.dim(); ++r) hyp.e[u(r)] -= update.K[r] * seen;
      }
    });
    const double square = correction_variance > 0.0 ? correction * correction / correction_variance : 0.0;
    mass_surprise_ += smoothing * (std::min(square, 3.0 / smoothing) - mass_surprise_);  // an outlier is seen, and forgotten again
    if (!filter_.healthy()) {  // start over rather than report what came out of it
      forget_everything();
      begin(s);
      return report(s, Status::warming);
    }
    look_for_unexplained(filter_.torque_of(dq, ddq, s.dt), s.dt);
    learn_model_error(s.dt);
    unexplained_time_ = explained() ? 0.0 : unexplained_time_ + s.dt;
    // Lost: it explains nothing, or by a load that weighs less than nothing.
    if (unexplained_time_ > 1.0 || filter_.parameter(0) < -2.0 * initial_prior_std_) {
      forget_everything();
      begin(s);
      return report(s, Status::warming);
    }
    if (filter_.parameter(0) > 2.0 * mass_prior_std_) {  // the prior was too narrow, and has held the estimate back
      mass_prior_std_ = 2.0 * filter_.parameter(0);
      forget_load();
      restart_hypotheses();
    }
    bound_first_moment();
    look_for_change(s);
    mass_before_ -= std::expm1(-s.dt / lag) * (filter_.parameter(0) - mass_before_);
    const Payload out = report(s, Status::ok);
    if (known_time_ < known_after) known_time_ = out.status == Status::ok ? known_time_ + s.dt : 0.0;
    return out;
  }

  void reset() { *this = PayloadFilter(*arm_, config_); }

  JointVector positions() const noexcept { return filter_.positions(); }
  JointVector velocities() const noexcept { return filter_.velocities(); }
  const Filter& filter() const noexcept { return filter_; }

  /// The load as a body on the last link, for the controller's feed-forward (never of negative mass).
  Inertia<double> load() const noexcept { return physical(load_of_state()); }

 private:
  static constexpr std::size_t u(int i) noexcept { return static_cast<std::size_t>(i); }
  static bool has_coulomb(const Arm& arm) noexcept {
    for (int i = 0; i < arm.n(); ++i)
      if (arm.joint(i).friction.uncertainty(0.0, 0.0, 1.0) > 0.0) return true;
    return false;
  }

  /// Largest mass every joint could hold with the arm stretched out level [kg].
  static double holdable_mass(const Arm& arm) noexcept {
    const Vec3<double> g = arm.gravity(), c = arm.p_last_grasp();
    double mass = std::numeric_limits<double>::infinity(), reach = std::sqrt(dot(c, c));
    for (int i = arm.n() - 1; i >= 0; --i) {
      mass = std::min(mass, arm.joint(i).max_effort / (std::sqrt(dot(g, g)) * std::max(reach, 0.01)));
      reach += std::sqrt(dot(arm.body(i).p, arm.body(i).p));
    }
    return std::isfinite(mass) ? mass : 5.0;
  }

  static bool has_rounding(const Arm& arm) noexcept {
    for (int i = 0; i < arm.n(); ++i)
      if (arm.joint(i).position_resolution > 0.0) return true;
    return false;
  }

  struct Hypothesis {
    std::array<double, Filter::max_dim> e;  ///< state error left now by a unit jump of the mass at `since`
    double num, den;
    double age, life;                       ///< [s]
    std::int64_t since;                     ///< [ns]
  };

  /// Averages over the last `memory` seconds, exponentially weighted once they are past.
  struct Window {
    double memory;                                               ///< [s]
    double span = 0.0, first = 1.0;                              ///< so far [s]; weight of the first sample
    JointVector torque{};                                        ///< lacking - D theta^ + b^ [N m]
    std::array<std::array<double, 4>, max_joints> lever{};       ///< D
    JointVector rho{}, white{}, bias{}, q_variance{};            ///< bias: variance of b; the last when it began
    JointMatrix dq_covariance{};                                 ///< likewise
    double hidden = 0.0;                                         ///< part of V's diagonal that the learnt model error makes
  };

  void begin(const JointSample& s) noexcept {
    filter_.start(*arm_, s, config_.velocity_prior_std);
    regime_ = detail::Regime(presliding);
    for (int i = 0; i < biases_; ++i) redraw_bias(i);
    started_ = true;
    restart_hypotheses();
    unsettled_ = least_span;
  }
  void forget_everything() noexcept {
    surprise_.fill(1.0);
    mass_surprise_ = 1.0;
    recent_surprise_.fill(1.0);
    hidden_variance_ = unexplained_time_ = 0.0;
    doubt_.fill(0.0);
    unlike_ = false;
    lately_evidence_ = doubtful_time_ = 0.0;
    mass_before_ = known_time_ = 0.0;
    mass_prior_std_ = initial_prior_std_;
    model_error_.fill(least_model_error);
    filter_.set_parameter(0, 0.0, mass_prior_std_ * mass_prior_std_);
    set_offset_prior();
  }
  void set_offset_prior() noexcept {
    const double moment = config_.offset_prior_std * mass_prior_std_;
    bounding_mass_ = mass_prior_std_;
    for (int k = 1; k < loads_; ++k) filter_.set_parameter(k, 0.0, moment * moment);
  }
  /// Makes the prior of m delta that of the mass as it is known now: the difference of information is a measurement of zero,
  /// a difference the other way is more variance.
  void bound_first_moment() noexcept {
    if (loads_ == 1) return;
    const double mass = std::max(std::abs(filter_.parameter(0)) + 2.0 * mass_std(), config_.ok_absolute);
    if (mass > 0.8 * bounding_mass_ && mass < 1.2 * bounding_mass_) return;
    const double before = config_.offset_prior_std * bounding_mass_, now = config_.offset_prior_std * mass;
    const double information = 1.0 / (now * now) - 1.0 / (before * before);
    for (int k = 1; k < loads_; ++k) {
      if (information <= 0.0) {
        filter_.add_parameter_variance(k, now * now - before * before);
        continue;
      }
      const int moment = 2 * arm_->n() + k;
      const Filter::Update update = filter_.measure(moment, -1, 0.0, 1.0 / information);
      for (Hypothesis& hyp : hypotheses_) {  // no evidence for or against a jump
        const double seen = hyp.e[u(moment)];
        for (int r = 0; r < filter_.dim(); ++r) hyp.e[u(r)] -= update.K[r] * seen;
      }
    }
    bounding_mass_ = mass;
  }
  /// The mass may be another one.
  void forget_load() noexcept {
    known_time_ = 0.0;
    filter_.set_parameter(0, filter_.parameter(0), mass_prior_std_ * mass_prior_std_);
    set_offset_prior();
  }

  Inertia<double> load_of_state() const noexcept {
    Inertia<double> load{};
    for (int k = 0; k < loads_; ++k) load = load + filter_.parameter(k) * unit_[u(k)];
    return load;
  }
  /// The load as the filter moves it. A little less than nothing, by noise, is a body like any other: what the arm does is
  /// then smooth in the mass, and the estimate of an empty hand unbiased. More, by a wrong model, is weight without inertia.
  Inertia<double> moving(const Inertia<double>& load) const noexcept {
    const bool little = -load.m * most_share_ < 0.3;
    return load.m < 0.0 && little ? -1.0 * physical(-1.0 * load) : physical(load);
  }
  /// A body that can be: c no further from the grasp point than a hand could hold it.
  Inertia<double> physical(const Inertia<double>& load) const noexcept {
    if (!(load.m > 0.0)) return Inertia<double>{};
    Vec3<double> moment = load.mc - load.m * arm_->p_last_grasp();
    const double limit = std::max(0.3, 4.0 * config_.offset_prior_std) * load.m, length = std::sqrt(dot(moment, moment));
    if (length > limit) moment = (limit / length) * moment;
    return about_origin(load.m, arm_->p_last_grasp() + (1.0 / load.m) * moment, Sym3<double>{});
  }

  double bias_variance(int i) const noexcept {
    const double dq = regime_.at_rest(i) ? 0.0 : filter_.dq(i);
    const double std = filter_.expected_friction(*arm_, i).uncertainty(dq, config_.friction_fraction, tau_[u(i)]);
    return std * std;
  }
  void redraw_bias(int i) noexcept { filter_.set_parameter(loads_ + i, 0.0, bias_variance(i)); }
  void predict(const JointSample& s, double h) noexcept {
    const double phi = std::exp(-h / config_.friction_time);
    for (int i = 0; i < biases_; ++i) {
      if (regime_.changed(*arm_, i, filter_.q(i), filter_.dq(i))) redraw_bias(i);
      decay_[u(loads_ + i)] = phi;
    }
    noise_ = torque_variance_;
    add_neglected(noise_, h);
    JointVector variance = noise_;
    for (int i = 0; i < arm_->n(); ++i) variance[u(i)] += model_error_[u(i)];
    const Inertia<double> state = load_of_state(), real = moving(state);
    const Inertia<double> rest{state.m - real.m, state.mc - real.mc, Sym3<double>{}};
    const int last = arm_->n() - 1;
    filter_.predict(*arm_, {s.tau, variance, real, rest, decay_}, h, [&](const BaseFrame& chain, double* D, int stride) {
      for (int p = 0; p < loads_; ++p) {
        const JointVector column = chain.body_torque(last, moved(chain.pose().R, chain.pose().p, unit_[u(p)]));
        for (int i = 0; i <= last; ++i) D[i * stride + p] = column[u(i)];
      }
    });
    for (int i = 0; i < biases_; ++i) {
      bias_variance_[u(i)] = bias_variance(i);
      filter_.add_parameter_variance(loads_ + i, (1.0 - phi * phi) * bias_variance_[u(i)]);
    }
    for (Hypothesis& hyp : hypotheses_) {
      filter_.propagate(hyp.e);
      hyp.age += h;
    }
  }

  /// A joint at rest that moves as b would not let it: its stiction broke, within the last step. b is drawn anew then, before the
  /// surprise is taken for a load.
  void look_for_breakaway(const JointSample& s) noexcept {
    for (int i = 0; i < biases_; ++i) {
      if (!regime_.at_rest(i)) continue;
      const Filter::Innovation seen = filter_.innovation(*arm_, s, i);
      if (seen.y * seen.y < breakaway * breakaway * seen.s) continue;
      const double b = filter_.parameter(loads_ + i);
      std::array<double, Filter::max_dim> e{};  // what a unit jump of b at the start of the step has left by now
      e[u(2 * arm_->n() + loads_ + i)] = 1.0;
      filter_.propagate(e);
      filter_.set_parameter(loads_ + i, b, 0.0);
      filter_.add_direction(e, -b, bias_variance_[u(i)]);
    }
  }

  /// An arm whose model is wrong, or that is pushed, surprises its filter: the innovations' y^2/S, 1 on average, stays above it.
  /// A torque variance per joint then grows until they fit, at once, and shrinks again: to what the unexplained torque shows
  /// within the time that is known over, below that slowly. The filter takes it for white; but it may as well stay, so that no
  /// averaging removes it: what it does to the mass is told by look_for_unexplained().
  void learn_model_error(double dt) noexcept {
    for (int i = 0; i < arm_->n(); ++i) {
      double& variance = model_error_[u(i)];
      const double lacks = std::max(std::abs(now_.rho[u(i)]), std::abs(lacking_[u(i)]));
      const double shown = 4.0 * lacks * lacks, excess = std::min(surprise_[u(i)], recent_surprise_[u(i)]) - 1.3;
      if (variance > shown) variance = std::max(shown, variance * std::exp(-2.0 * dt / memory));
      else if (excess > 0.0) variance = std::min(shown, variance * std::exp(std::min(std::min(excess, 3.0) / 0.02 * dt, 2.0)));
      else variance *= std::exp(dt * std::max(surprise_[u(i)] - 1.3, -1.0));
      variance = std::clamp(variance, least_model_error, 1e6);
    }
  }

  void restart(Window& w) noexcept {
    w.span = 0.0;
    w.first = 1.0;
    w.torque = w.white = w.bias = w.rho = {};
    w.lever = {};
    for (int i = 0; i < arm_->n(); ++i) {
      w.q_variance[u(i)] = filter_.variance(i);
      for (int j = 0; j <= i; ++j) w.dq_covariance(i, j) = w.dq_covariance(j, i) = filter_.covariance(arm_->n() + i, arm_->n() + j);
    }
  }
  /// A push is no load: its torques stand to each other as no load's do. What the state lacks to follow the positions, as a
  /// torque (JointKalman::torque_of), is averaged over the last 0.3 s, and over 3 s as long as it stays the same:
  ///   rho = mean(lacking - D theta^ + b^) + mean(D) theta^ ~ N(0, V),   D the torque per unit of theta, theta^ the estimate,
  ///   V = noise/N + (W cov(q') W^T + var(B q))(begin, end)/span^2 + mean(var(b)) + mean(D) P mean(D)^T
  /// where a load is all there is. If rho^T V^-1 rho says otherwise, any part of what looks like a load may
  /// be none: a parameter is then not known better than rho^2/D^2, the change that would take as much torque, times
  /// n/(n - parameters), for so much of a torque the fit has taken on itself. When it is over, what was learnt meanwhile is as
  /// doubtful, and is learnt anew.
  void look_for_unexplained(const JointVector& lacking, double dt) noexcept {
    const int n = arm_->n();
    unsettled_ -= dt;
    if (unsettled_ > 0.0) restart(now_);  // corrections are still those of the guess it began with
    if (now_.span < now_.memory) restart(lately_);
    for (double& doubt : doubt_) doubt *= std::exp(-dt / 0.1);
    average(now_, lacking, dt);
    average(lately_, lacking, dt);
    const Cholesky<double> V(covariance(now_, dt), n);
    const double unknown = mass_prior_std_ * mass_prior_std_;
    hidden_variance_ = V.positive() ? std::min(unknown, now_.hidden / std::max(squared_lever(now_, 0), 1e-12)) : unknown;
    double evidence = now_.span < least_span ? 0.0 : deviations(V, now_.rho);
    if (evidence > doubtful) {
      doubt(now_, evidence);
      restart(lately_);
    }
    since_test_ += dt;
    if (since_test_ >= 0.02) {
      since_test_ = 0.0;
      JointVector change{};
      for (int i = 0; i < n; ++i) change[u(i)] = lately_.rho[u(i)] - now_.rho[u(i)];
      if (now_.span >= least_span && deviations(V, change) > doubtful) restart(lately_);
      lately_evidence_ = lately_.span < least_span ? 0.0 : deviations(Cholesky<double>(covariance(lately_, dt), n), lately_.rho);
      if (lately_evidence_ > doubtful) doubt(lately_, lately_evidence_);
    }
    evidence = std::max(evidence, lately_evidence_);
    if (unlike_ && evidence < doubtful) {
      for (int k = 0; k < loads_; ++k) filter_.add_parameter_variance(k, doubt_[u(k)]);
      unlike_ = false;
    }
    doubtful_time_ = evidence > doubtful ? doubtful_time_ + dt : 0.0;
    unlike_ = unlike_ || evidence > certain || doubtful_time_ > lasting;
    const double quick = -std::expm1(-dt / 0.03);
    for (int i = 0; i < n; ++i) lacking_[u(i)] += quick * (lacking[u(i)] - lacking_[u(i)]);
  }
  void average(Window& w, const JointVector& lacking, double dt) noexcept {
    w.span = std::min(w.span + dt, w.memory);
    const double a = std::min(dt / w.span, 1.0);
    w.first = w.span < w.memory ? a : w.first * (1.0 - a);
    for (int i = 0; i < arm_->n(); ++i) {
      const auto& D = lever_[u(i)];
      auto& mean = w.lever[u(i)];
      double torque = lacking[u(i)] + (biases_ > 0 ? filter_.parameter(loads_ + i) : 0.0), expected = 0.0;
      for (int k = 0; k < loads_; ++k) {
        torque -= D[u(k)] * filter_.parameter(k);
        mean[u(k)] += a * (D[u(k)] - mean[u(k)]);
        expected += mean[u(k)] * filter_.parameter(k);
      }
      w.torque[u(i)] += a * (torque - w.torque[u(i)]);
      w.rho[u(i)] = w.torque[u(i)] + expected;
      w.white[u(i)] = (1.0 - a) * (1.0 - a) * w.white[u(i)] + a * a * noise_[u(i)];
      w.bias[u(i)] += a * (bias_variance_[u(i)] - w.bias[u(i)]);
    }
  }
  /// V, the lower triangle.
  JointMatrix covariance(Window& w, double dt) const noexcept {
    const int n = arm_->n();
    JointMatrix V{};
    w.hidden = 0.0;
    const double first = w.first / dt;
    const JointMatrix& W = filter_.mass();
    JointMatrix WE{};  // W times the covariance of (q'(end) - q'(begin))/span
    for (int k = 0; k < n; ++k)
      for (int l = 0; l < n; ++l) {
        const double E = filter_.covariance(n + std::max(k, l), n + std::min(k, l)) / (w.span * w.span) + w.dq_covariance(k, l) * first * first;
        for (int i = 0; i < n; ++i) WE(i, l) += W(i, k) * E;
      }
    for (int i = 0; i < n; ++i) {
      for (int j = 0; j <= i; ++j)
        for (int k = 0; k < n; ++k) V(i, j) += WE(i, k) * W(j, k);
      const double B = filter_.damping()[u(i)];
      const double friction = B * B * (filter_.variance(i) / (w.span * w.span) + w.q_variance[u(i)] * first * first);
      const double variance = w.white[u(i)] + V(i, i) + friction;
      const double learnt = model_error_[u(i)] - least_model_error;
      w.hidden += variance * learnt / (learnt + noise_[u(i)] + 1e-12);
      std::array<double, 4> DP{};
      for (int k = 0; k < loads_; ++k)
        for (int l = 0; l < loads_; ++l) DP[u(k)] += w.lever[u(i)][u(l)] * filter_.covariance(2 * n + l, 2 * n + k);
      for (int j = 0; j <= i; ++j)
        for (int k = 0; k < loads_; ++k) V(i, j) += DP[u(k)] * w.lever[u(j)][u(k)];
      V(i, i) += w.white[u(i)] + friction + w.bias[u(i)];
    }
    return V;
  }
  /// x^T V^-1 x in standard deviations of the normal distribution that has as rare values (Wilson, Hilferty 1931).
  /// Where rounding leaves no V, nothing is sure.
  double deviations(const Cholesky<double>& V, const JointVector& x) const noexcept {
    if (!V.positive()) return 2.0 * certain;
    const JointVector y = V.solve(x);
    double chi_square = 0.0;
    for (int i = 0; i < arm_->n(); ++i) chi_square += x[u(i)] * y[u(i)];
    const double part = 2.0 / (9.0 * arm_->n());
    return (std::cbrt(chi_square / arm_->n()) - 1.0 + part) / std::sqrt(part);
  }
  double squared_lever(const Window& w, int k) const noexcept {
    double sum = 0.0;
    for (int i = 0; i < arm_->n(); ++i) sum += w.lever[u(i)][u(k)] * w.lever[u(i)][u(k)];
    return sum;
  }
  void doubt(const Window& w, double evidence) noexcept {
    const int n = arm_->n();
    double squares = 0.0, as_mass = 0.0;
    for (int i = 0; i < n; ++i) {
      squares += w.rho[u(i)] * w.rho[u(i)];
      as_mass -= w.lever[u(i)][0] * w.rho[u(i)];
    }
    const double taken = static_cast<double>(n) / std::max(n - loads_, 1);
    for (int k = 0; k < loads_; ++k) {
      const double prior = k == 0 ? mass_prior_std_ : config_.offset_prior_std * bounding_mass_;
      doubt_[u(k)] = std::max(doubt_[u(k)], std::min(prior * prior, taken * squares / std::max(squared_lever(w, k), 1e-12)));
    }
    // What is a mass but for a rest that is small beside it, and was overlooked for the filter thought it knew better: learnt.
    const double lever = std::max(squared_lever(w, 0), 1e-12), mass_square = as_mass * as_mass / (lever * lever);
    const double missing = mass_square - filter_.parameter_variance(0);
    if (evidence > certain && missing > 0.0 && mass_square * lever * (n - 1) > 4.0 * (squares - mass_square * lever)) filter_.add_parameter_variance(0, missing);
  }

  /// Whether the state explains what every joint does now.
  bool explained() const noexcept {
    return std::all_of(surprise_.begin(), surprise_.begin() + arm_->n(), [](double s) { return s < 2.0; });
  }
  /// Whether the mass is corrected no more than is expected: a joint that tells nothing of it may do what it likes.
  bool settled() const noexcept { return mass_surprise_ < 2.0; }
  /// Mean surprise of the joints, at least 1.
  double surprise() const noexcept {
    double sum = 0.0;
    for (int i = 0; i < arm_->n(); ++i) sum += surprise_[u(i)];
    return std::max(1.0, sum / arm_->n());
  }

  /// What linearisation in the mass and the state leave out, as extra torque variance [N^2 m^2].
  /// Lever: weight torque is m times a lever that moves with q, so var(m) sum_j (d lever_i / dq_j)^2 var(z_j). Without it a
  /// filter that starts hanging, where the lever is zero, believes in masses it has read from its own noise.
  /// Inertia: q'' is not linear in m where the load may outweigh the links, so (std(m) J_i.(a_c - g))^2 times
  /// (std(m) J_i.J_i / W_ii)^2, at most 1. Without it the first samples of a light arm are taken for a weighing.
  /// Rotation: the load's own inertia, m r^2 at most, times the angular acceleration about the joint.
  /// The latter two are no noise but last for a time `lag`: noise drawn anew every h leaves as much doubt over it if its variance
  /// is lag/h times theirs. The first two vanish as the mass becomes known.
  void add_neglected(JointVector& variance, double h) noexcept {
    const Pose<double> P = forward_kinematics<double>(*arm_, filter_.positions());
    const Vec3<double> c = P.p + P.R * arm_->p_last_grasp(), g = arm_->gravity();
    const double mass_variance = filter_.parameter_variance(0);
    std::array<Vec3<double>, max_joints> J;
    const double samples = std::max(1.0, lag / h), radius = loads_ > 1 ? 2.0 * config_.offset_prior_std : 0.0;
    const double own_inertia = std::abs(filter_.parameter(0)) * radius * radius;
    Vec3<double> a_c{}, spin{};
    for (int j = 0; j < arm_->n(); ++j) {
      J[u(j)] = jacobian_column(*arm_, P, j, c);
      a_c = a_c + filter_.acceleration()[u(j)] * J[u(j)];
      if (!arm_->body(j).prismatic) spin = spin + filter_.acceleration()[u(j)] * P.axis[u(j)];
      for (int i = 0; i <= j; ++i) {
        if (arm_->body(i).prismatic) continue;
        const double slope = dot(cross(P.axis[u(i)], J[u(j)]), g);
        variance[u(i)] += mass_variance * slope * slope * arm_->position_variance(j);
        if (i != j) variance[u(j)] += mass_variance * slope * slope * arm_->position_variance(i);
      }
    }
    most_share_ = 0.0;
    const JointMatrix& W = filter_.mass();
    const Mat3<double> R = P.R * arm_->R_last_tip();
    const std::array<Vec3<double>, 3> tip{R.cx, R.cy, R.cz};
    for (int i = 0; i < arm_->n(); ++i) {
      const double torque = dot(J[u(i)], a_c - g);
      lever_[u(i)][0] = torque;
      if (!arm_->body(i).prismatic)
        for (int k = 1; k < loads_; ++k) lever_[u(i)][u(k)] = dot(cross(P.axis[u(i)], tip[u(k - 1)]), a_c - g);
      const double share = dot(J[u(i)], J[u(i)]) / std::max(W(i, i), 1e-12);
      most_share_ = std::max(most_share_, share);
      variance[u(i)] += samples * mass_variance * torque * torque * std::min(1.0, mass_variance * share * share);
      const double turning = arm_->body(i).prismatic ? 0.0 : own_inertia * dot(P.axis[u(i)], spin);
      variance[u(i)] += samples * turning * turning;
    }
  }

  void start_hypothesis(Hypothesis& hyp, std::int64_t now) noexcept {
    hyp.e.fill(0.0);
    hyp.e[u(2 * arm_->n())] = 1.0;
    hyp.num = hyp.den = hyp.age = 0.0;
    hyp.since = now;
  }
  /// Eight hypotheses of up to 0.28 s for firm changes and four of up to 1 s for faint ones, evenly staggered.
  void restart_hypotheses() noexcept {
    for (int i = 0; i < 12; ++i) {
      Hypothesis& hyp = hypotheses_[u(i)];
      start_hypothesis(hyp, 0);
      hyp.life = i < 8 ? 0.28 : 1.0;
      hyp.age = i < 8 ? hyp.life * i / 8.0 : hyp.life * (i - 8) / 4.0;
      hyp.e.fill(0.0);  // empty until its turn comes
    }
  }

  void look_for_change(const JointSample& s) noexcept {
    const Hypothesis* best = nullptr;
    double best_score = config_.change_threshold * config_.change_threshold;
    const double prior_information = 1.0 / (mass_prior_std_ * mass_prior_std_);
    const auto jump_of = [&](const Hypothesis& hyp) { return hyp.num / (hyp.den + prior_information); };
    for (const Hypothesis& hyp : hypotheses_) {
      const double score = hyp.num * jump_of(hyp) / surprise();
      if (hyp.den > 0.0 && score > best_score && std::abs(jump_of(hyp)) >= config_.min_change) {
        best_score = score;
        best = &hyp;
      }
    }
    if (best != nullptr && mass_std() < mass_prior_std_ / 3.0) {
      const double jump = jump_of(*best);
      // A small one soon after a change is what the first guess of its size and instant left over: corrected, not counted.
      const bool correction = changes_ > 0 && s.time_ns - change_seen_ns_ < 1'000'000'000 && std::abs(jump) < 0.5 * last_jump_;
      const double prior = correction ? 2.0 * std::abs(jump) : mass_prior_std_;
      if (!correction && known_time_ >= known_after) {
        ++changes_;
        change_time_ns_ = best->since;
        change_seen_ns_ = s.time_ns;
        last_jump_ = std::abs(jump);
      }
      for (const Hypothesis& hyp : hypotheses_) {  // the change came between the instants that were tried
        const auto apart = hyp.since > best->since ? hyp.since - best->since : best->since - hyp.since;
        if (&hyp == best || !(hyp.den > 0.0) || apart > 130'000'000) continue;
        std::array<double, Filter::max_dim> e = hyp.e;
        for (int r = 0; r < filter_.dim(); ++r) e[u(r)] -= best->e[u(r)];
        filter_.add_direction(e, 0.0, jump * jump);
      }
      filter_.add_direction(best->e, jump, prior * prior);
      if (!correction) set_offset_prior();
      mass_before_ = filter_.parameter(0);
      restart_hypotheses();
      unsettled_ = memory;
      return;
    }
    for (Hypothesis& hyp : hypotheses_)
      if (hyp.age >= hyp.life) start_hypothesis(hyp, s.time_ns);
  }

  double mass_std() const noexcept { return std::sqrt(std::max(filter_.parameter_variance(0), 0.0)); }

  Payload report(const JointSample&, Status status) const noexcept {
    Payload out;
    out.mass = filter_.parameter(0);
    out.mass_std = std::hypot(mass_std(), std::sqrt(doubt_[0] + hidden_variance_), out.mass - mass_before_);
    for (int k = 1; k < loads_; ++k) {
      out.first_moment[u(k - 1)] = filter_.parameter(k);
      out.first_moment_std[u(k - 1)] = std::sqrt(std::max(filter_.parameter_variance(k), 0.0) + doubt_[u(k)]);
    }
    out.changes = changes_;
    out.change_time_ns = change_time_ns_;
    out.status = status;
    const bool sure = out.mass_std <= std::max(config_.ok_relative * std::abs(out.mass), config_.ok_absolute);
    const bool possible = out.mass >= -std::max(3.0 * out.mass_std, config_.ok_absolute);
    if (status == Status::ok && !(sure && possible && settled() && now_.span >= least_span)) out.status = Status::warming;
    return out;
  }

  const Arm* arm_;
  PayloadFilterConfig config_;
  int loads_, biases_;
  double initial_prior_std_, mass_prior_std_ = 0.0;  // [kg]; the latter is widened if need be
  Filter filter_;
  std::array<Inertia<double>, 4> unit_;
  static constexpr double least_model_error = 1e-6;  // [N^2 m^2]
  static constexpr double memory = 0.3;              // over which surprise and unexplained torque are averaged [s]
  JointVector tau_{}, torque_variance_{}, surprise_{}, recent_surprise_{}, model_error_{};
  JointVector bias_variance_{};                       // of b in the last prediction, 0 without [N^2 m^2]
  JointVector noise_{};                               // of the torque without the model error, per step [N^2 m^2]
  std::array<std::array<double, 4>, max_joints> lever_{};  // torque per parameter of the load
  JointVector lacking_{};                             // over 0.03 s [N m]
  Window now_{.memory = memory}, lately_{.memory = 10.0 * memory};
  static constexpr double least_span = 0.1;           // before which a window tells nothing [s]
  std::array<double, 4> doubt_{};                     // variances of the load's parameters while something else is felt
  double hidden_variance_ = 0.0;                      // of the mass, by torques that the learnt model error would hide [kg^2]
  double unsettled_ = 0.0;                            // for so long what is lacking tells nothing [s]
  double since_test_ = 0.0;                           // of what was felt lately [s]
  static constexpr double doubtful = 4.0, certain = 7.0;  // standard deviations that make a torque no load's
  static constexpr double lasting = 0.3;              // a doubt that stays for so long [s] is as certain
  double lately_evidence_ = 0.0;                      // such, at the last test
  double doubtful_time_ = 0.0;                        // for so long it has been [s]
  double mass_surprise_ = 1.0;                        // squared correction of the mass over its variance
  bool unlike_ = false;                               // something else than a load has certainly been felt
  Filter::Parameters decay_{};
  static constexpr double presliding = 5e-3;  // [rad]
  static constexpr double breakaway = 5.0;    // standard deviations by which a joint at rest may surprise
  static constexpr double lag = 0.1;          // errors of linearisation last about so long [s]
  static constexpr double known_after = 0.3;  // [s]
  detail::Regime regime_{presliding};
  std::array<Hypothesis, 12> hypotheses_;
  bool started_ = false;
  std::uint32_t changes_ = 0;
  std::int64_t change_time_ns_ = 0, change_seen_ns_ = 0;
  double last_jump_ = 0.0;  // [kg]
  double unexplained_time_ = 0.0;      // [s]
  double mass_before_ = 0.0;           // the estimate about `lag` ago [kg]
  double known_time_ = 0.0;            // `ok` without a break since the load was forgotten, up to known_after [s]
  double bounding_mass_ = 0.0;         // whose first moment's prior holds [kg]
  double most_share_ = 0.0;            // of a joint's inertia, per mass at the grasp point [1/kg]
};

}  // namespace palpate
