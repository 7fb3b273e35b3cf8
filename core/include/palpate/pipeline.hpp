// Pipeline: one raw sample in, everything known about touch out. The only path, live, simulated, replayed and in batch.
#pragma once
#include <memory>
#include <optional>
#include <variant>

#include "palpate/conditioner.hpp"
#include "palpate/contact.hpp"
#include "palpate/observers/disturbance_kalman.hpp"
#include "palpate/observers/extended_kalman.hpp"
#include "palpate/observers/inverse_dynamics.hpp"
#include "palpate/observers/momentum.hpp"
#include "palpate/observers/momentum_super_twisting.hpp"
#include "palpate/observers/sliding_mode.hpp"
#include "palpate/payload.hpp"
#include "palpate/payload_filter.hpp"
#include "palpate/wrench.hpp"

namespace palpate {

/// Which observer, if any, turns samples into external torque; its configuration chooses it.
using ObserverConfig = std::variant<std::monostate, InverseDynamicsConfig, ModelResidualConfig, SlidingModeConfig, MomentumConfig,
                                    SuperTwistingConfig, DisturbanceKalmanConfig, ExtendedKalmanConfig>;
/// Which estimator, if any, weighs.
using PayloadConfig = std::variant<std::monostate, JointFormulaConfig, RegressionConfig, PayloadFilterConfig>;

struct PipelineConfig {
  ConditionerConfig conditioner{};
  ObserverConfig observer{};
  PayloadConfig payload{PayloadFilterConfig{}};
  LoadConfig load{};                      ///< what wrench and contact take away as held
  std::optional<WrenchConfig> wrench{};   ///< needs an observer
  std::optional<ContactConfig> contact{};
};

/// RawSample -> Conditioner -> observer -> payload estimator -> wrench, contact -> Touch (DESIGN.md section 1).
///
/// step() allocates nothing, throws nothing, locks nothing and reads no clock; its work is bounded by the number of joints.
/// The same samples give the same bits, one by one or in batches.
class Pipeline {
 public:
  Pipeline(std::shared_ptr<const Arm> arm, const PipelineConfig& config)
      : arm_(std::move(arm)), config_(config), conditioner_(arm_->n(), gains(*arm_), config.conditioner), load_(*arm_, config.load) {
    make();
  }

  Touch step(const RawSample& raw) noexcept {
    JointSample s = conditioner_.step(raw);
    const double gain = conditioner_.velocity_noise_gain();
    for (int j = 0; j < arm_->n(); ++j) {
      // A driver's velocity of undeclared quality is taken for what it mostly is: a difference of the same positions.
      const double declared = arm_->joint(j).velocity_std;
      const bool use = s.velocity_measured && std::isfinite(declared);
      s.dq_std[detail::at(j)] = use ? declared : gain * std::sqrt(arm_->position_variance(j));
    }
    friction_.step(*arm_, s);
    Touch touch;
    touch.time_ns = s.time_ns;
    touch.status = s.status;
    touch.q = s.q;
    touch.dq = s.dq;
    touch.external.status = Status::held;
    touch.payload.status = Status::held;
    touch.wrench.status = Status::held;
    touch.contact.status = Status::held;
    std::visit([&](auto& observer) { observe(observer, s, touch); }, observer_);
    std::visit([&](auto& estimator) { weigh(estimator, s, touch); }, payload_);
    if (wrench_ || contact_) {
      // A contact looks like a load to the payload estimators: what was held before it is what is held.
      load_.step(s, touched_ ? Payload{} : touch.payload);
      if (contact_) {
        touch.contact = contact_->step(s, load_);
        touched_ = touch.contact.active;
      }
      if (wrench_) {
        const JointMatrix sigma = std::visit([&](const auto& observer) { return covariance(observer, touch.external); }, observer_);
        touch.wrench = wrench_->step(s.q, touch.external, sigma, load_);
      }
    }
    return touch;
  }

  /// Back to the state before the first sample.
  void reset() {
    conditioner_.reset();
    make();
  }

  const Arm& arm() const noexcept { return *arm_; }
  const PipelineConfig& config() const noexcept { return config_; }
  /// What is held as a body on the last link, for feed-forward; zero unless the payload filter says `ok`.
  Inertia<double> load() const noexcept {
    const auto* filter = std::get_if<PayloadFilter>(&payload_);
    return filter != nullptr && weighed_ ? filter->load() : Inertia<double>{};
  }

 private:
  static JointVector gains(const Arm& arm) noexcept {
    JointVector gain{};
    for (int j = 0; j < arm.n(); ++j) gain[detail::at(j)] = arm.joint(j).effort_gain;
    return gain;
  }

  /// How late the observer's torque is now [s].
  double lag() const noexcept {
    return std::visit(
        [](const auto& observer) {
          if constexpr (requires { observer.lag(); }) return observer.lag();
          else return 0.0;
        },
        observer_);
  }

  void make() {
    friction_ = {};
    weighed_ = touched_ = false;
    const Arm& arm = *arm_;
    load_.reset();
    wrench_.reset();
    contact_.reset();
    if (config_.wrench) wrench_.emplace(arm, *config_.wrench);
    if (config_.contact) contact_.emplace(arm, *config_.contact);
    struct {
      const Arm& arm;
      decltype(observer_)& to;
      void operator()(std::monostate) const { to.emplace<std::monostate>(); }
      void operator()(const InverseDynamicsConfig& c) const { to.emplace<InverseDynamicsObserver>(arm, c); }
      void operator()(const ModelResidualConfig& c) const { to.emplace<ModelResidualObserver>(arm, c); }
      void operator()(const SlidingModeConfig& c) const { to.emplace<SlidingModeObserver>(arm, c); }
      void operator()(const MomentumConfig& c) const { to.emplace<MomentumObserver>(arm, c); }
      void operator()(const SuperTwistingConfig& c) const { to.emplace<MomentumSuperTwisting>(arm, c); }
      void operator()(const DisturbanceKalmanConfig& c) const { to.emplace<DisturbanceKalman>(arm, c); }
      void operator()(const ExtendedKalmanConfig& c) const { to.emplace<ExtendedKalman>(arm, c); }
    } observer_maker{arm, observer_};
    std::visit(observer_maker, config_.observer);
    struct {
      const Arm& arm;
      decltype(payload_)& to;
      void operator()(std::monostate) const { to.emplace<std::monostate>(); }
      void operator()(const JointFormulaConfig& c) const { to.emplace<JointFormula>(arm, c); }
      void operator()(const RegressionConfig& c) const { to.emplace<Regression>(arm, c); }
      void operator()(const PayloadFilterConfig& c) const { to.emplace<PayloadFilter>(arm, c); }
    } payload_maker{arm, payload_};
    std::visit(payload_maker, config_.payload);
    const bool needs_torque = std::holds_alternative<JointFormulaConfig>(config_.payload) || std::holds_alternative<RegressionConfig>(config_.payload);
    if (needs_torque && std::holds_alternative<std::monostate>(config_.observer))
      throw std::invalid_argument("Pipeline: the joint formula and the regression weigh an external torque; choose an observer too");
    if (config_.wrench && std::holds_alternative<std::monostate>(config_.observer))
      throw std::invalid_argument("Pipeline: the wrench is made of an external torque; choose an observer too");
  }

  /// The observer's own covariance where it has one, else its variances.
  template <class Observer>
  JointMatrix covariance(const Observer& observer, const ExternalTorque& external) const noexcept {
    if constexpr (requires { observer.covariance(); }) {
      return observer.covariance();
    } else {
      JointMatrix out{};
      for (int j = 0; j < arm_->n(); ++j) out(j, j) = external.std[detail::at(j)] * external.std[detail::at(j)];
      return out;
    }
  }

  void observe(std::monostate, const JointSample&, Touch&) noexcept {}
  template <class Observer>
  void observe(Observer& observer, const JointSample& s, Touch& touch) noexcept {
    touch.external = observer.step(s);
    if constexpr (std::is_same_v<Observer, SlidingModeObserver> || std::is_same_v<Observer, ExtendedKalman>) {
      touch.q = observer.positions();
      touch.dq = observer.velocities();
    }
  }

  void weigh(std::monostate, const JointSample&, Touch&) noexcept {}
  void weigh(JointFormula& formula, const JointSample& s, Touch& touch) noexcept {
    touch.payload = formula.step(s.q, touch.dq, touch.external);
    if (detail::unusable(s)) touch.payload.status = Status::held;
  }
  void weigh(Regression& regression, const JointSample& s, Touch& touch) noexcept {
    touch.payload = regression.step(s, touch.external, lag());
  }
  void weigh(PayloadFilter& filter, const JointSample& s, Touch& touch) noexcept {
    touch.payload = filter.step(s);
    touch.q = filter.positions();
    touch.dq = filter.velocities();
    weighed_ = touch.payload.status == Status::ok || (weighed_ && touch.payload.status == Status::held);
  }

  std::shared_ptr<const Arm> arm_;
  PipelineConfig config_;
  Conditioner conditioner_;
  FrictionMemory friction_{};
  std::variant<std::monostate, InverseDynamicsObserver, ModelResidualObserver, SlidingModeObserver, MomentumObserver, MomentumSuperTwisting,
               DisturbanceKalman, ExtendedKalman>
      observer_;
  std::variant<std::monostate, JointFormula, Regression, PayloadFilter> payload_;
  LoadTorque load_;
  std::optional<WrenchEstimator> wrench_;
  std::optional<ContactDetector> contact_;
  bool weighed_ = false, touched_ = false;
};

}  // namespace palpate
