// The rival: the same observers and filters on Pinocchio's algorithms and fixed-size Eigen matrices.
//
// Written to be as fast as Pinocchio's interface allows. All joints are turned to revolute-z, its cheapest type (the URDF
// parser's choice for other axes is slower by up to 10 %); crba in the LOCAL, aba in the WORLD convention, each its faster
// one; header-only, so that everything is inlined (slower by up to 15 % from the compiled library); joint-space matrices of
// fixed size 7. What is not dynamics (friction, low-pass) is palpate's own code, compiled with this file's flags.
#include "palpate/observers/momentum.hpp"
#include "palpate/observers/sliding_mode.hpp"
#include "rival.hpp"
#include "rival_kalman.hpp"

namespace {

using namespace rival;
using contest::Job;

// --- dynamics ----------------------------------------------------------------------------------------------------

struct InverseDynamics : Rival {
  using Rival::Rival;
  void step(const JointSample& s) { pin::rnea(model, data, in(s.q), in(s.dq), in(s.tau)); }  // any numbers will do for q''
  Numbers numbers() const {
    Numbers out;
    out.add(data.tau, N);
    return out;
  }
};

struct MassMatrix : Rival {
  using Rival::Rival;
  void step(const JointSample& s) { pin::crba(model, data, in(s.q), pin::Convention::LOCAL); }
  Numbers numbers() const {
    Numbers out;
    for (int i = 0; i < N; ++i)
      for (int j = i; j < N; ++j) out.add(data.M(i, j));
    return out;
  }
};

struct ForwardDynamics : Rival {
  using Rival::Rival;
  void step(const JointSample& s) { pin::aba(model, data, in(s.q), in(s.dq), in(s.tau), pin::Convention::WORLD); }
  Numbers numbers() const {
    Numbers out;
    out.add(data.ddq, N);
    return out;
  }
};

/// The way palpate goes: mass matrix, bias, Cholesky.
struct ForwardDynamicsByCholesky : Rival {
  using Rival::Rival;
  void step(const JointSample& s) {
    ddq = in(s.tau) - pin::nonLinearEffects(model, data, in(s.q), in(s.dq));
    const Square M = pin::crba(model, data, in(s.q), pin::Convention::LOCAL);
    Factor(M).solveInPlace(ddq);
  }
  Numbers numbers() const {
    Numbers out;
    out.add(ddq, N);
    return out;
  }
  Vector ddq;
};

// --- momentum observer -------------------------------------------------------------------------------------------

/// p, C^T q' and g from three algorithms.
struct TermsByMatrices {
  static void compute(Rival& r, const JointSample& s, Vector& p, Vector& Ct_dq, Vector& g) {
    const auto q = in(s.q), dq = in(s.dq);
    g = pin::computeGeneralizedGravity(r.model, r.data, q);
    const Square M = pin::crba(r.model, r.data, q, pin::Convention::LOCAL);
    p.noalias() = M.selfadjointView<Eigen::Upper>() * dq;
    const Square C = pin::computeCoriolisMatrix(r.model, r.data, q, dq);
    Ct_dq.noalias() = C.transpose() * dq;
  }
};

/// p = M q' as inverse dynamics at q'' = q' without M.
struct TermsByNewtonEuler {
  static void compute(Rival& r, const JointSample& s, Vector& p, Vector& Ct_dq, Vector& g) {
    const auto q = in(s.q), dq = in(s.dq);
    g = pin::computeGeneralizedGravity(r.model, r.data, q);
    p = pin::rnea(r.model, r.data, q, Vector::Zero(), dq) - g;
    const Square C = pin::computeCoriolisMatrix(r.model, r.data, q, dq);
    Ct_dq.noalias() = C.transpose() * dq;
  }
};

/// palpate's sweep, written by hand on Pinocchio's kinematics and spatial types.
struct TermsByOwnSweep {
  static void compute(Rival& r, const JointSample& s, Vector& p, Vector& Ct_dq, Vector& g) {
    const pin::Model& model = r.model;
    pin::Data& d = r.data;
    pin::forwardKinematics(model, d, in(s.q), in(s.dq));
    Eigen::Vector3d gravity[N + 1];
    gravity[0] = model.gravity.linear();
    for (pin::JointIndex i = 1; i <= N; ++i) {
      gravity[i].noalias() = d.liMi[i].rotation().transpose() * gravity[i - 1];
      d.h[i] = model.inertias[i] * d.v[i];
    }
    double m = 0.0;
    Eigen::Vector3d mc = Eigen::Vector3d::Zero();
    for (pin::JointIndex i = N; i > 0; --i) {
      const auto j = static_cast<Eigen::Index>(i) - 1;
      m += model.inertias[i].mass();
      mc += model.inertias[i].mass() * model.inertias[i].lever();
      const Eigen::Vector3d l = d.h[i].linear(), k = d.h[i].angular(), v = d.v[i].linear(), w = d.v[i].angular();
      p[j] = k.z() + model.armature[j] * s.dq[u(static_cast<int>(j))];
      Ct_dq[j] = (w.y() * k.x() - w.x() * k.y()) + (v.y() * l.x() - v.x() * l.y());
      g[j] = mc.y() * gravity[i].x() - mc.x() * gravity[i].y();
      if (i > 1) {
        d.h[i - 1] += d.liMi[i].act(d.h[i]);
        mc = d.liMi[i].rotation() * mc + m * d.liMi[i].translation();
      }
    }
  }
};

/// MomentumObserver::step with Eigen's vectors.
template <class Terms>
class Momentum {
 public:
  explicit Momentum(const palpate::ArmDescription& description) : rival_(description) {}
  void step(const JointSample& s) {
    Vector p, Ct_dq, g, beta;
    Terms::compute(rival_, s, p, Ct_dq, g);
    const Arm& arm = rival_.arm;
    for (int j = 0; j < N; ++j) beta[j] = Ct_dq[j] - g[j] - arm.joint(j).friction.torque(s.dq[u(j)]);
    if (started_) {
      const double a = std::exp(-config_.bandwidth * s.dt), b = 1.0 - a;
      refresh_noise(s);
      r_ = a * r_ + b * ((p - p_) / s.dt - in(s.tau) - 0.5 * (beta + beta_));
      for (int j = 0; j < N; ++j) {
        const double friction = arm.joint(j).friction.uncertainty(s.dq[u(j)], config_.friction_fraction);
        variance_[j] = b / (1.0 + a) * arm.torque_variance(j) + 2.0 / (1.0 + a) * (b / s.dt) * (b / s.dt) * p_variance_[j] +
                       friction * friction;
      }
    }
    p_ = p;
    beta_ = beta;
    started_ = true;
    std_ = variance_.cwiseSqrt();
  }
  Numbers numbers() const {
    Numbers out;
    out.add(r_, N);
    out.add(std_, N);
    return out;
  }

 private:
  void refresh_noise(const JointSample& s) {
    if (((in(s.q) - noise_q_).array().abs() <= 0.1).all()) return;
    const Square M = pin::crba(rival_.model, rival_.data, in(s.q), pin::Convention::LOCAL);
    const Square full = M.selfadjointView<Eigen::Upper>();
    p_variance_ = full.cwiseAbs2() * in(s.dq_std).cwiseAbs2();
    noise_q_ = in(s.q);
  }
  Rival rival_;
  palpate::MomentumConfig config_;
  bool started_ = false;
  Vector p_ = Vector::Zero(), beta_ = Vector::Zero(), r_ = Vector::Zero(), variance_ = Vector::Zero(), std_ = Vector::Zero();
  Vector p_variance_ = Vector::Zero(), noise_q_ = Vector::Constant(1e9);
};

// --- sliding-mode observer ---------------------------------------------------------------------------------------

/// SlidingModeObserver::step with the Runge-Kutta solver; bias by nonLinearEffects, one mass matrix per sample.
class SlidingMode {
 public:
  SlidingMode(const palpate::ArmDescription& description, int substeps)
      : rival_(description),
        steps_(substeps),
        low_pass_(palpate::Butterworth::from_rad_per_s(config_.order, config_.cutoff), N, palpate::Start::zero) {}

  void step(const JointSample& s) {
    if (!started_) {
      x1_ = in(s.q);
      x2_.setZero();
      started_ = true;
      return;
    }
    const Arm& arm = rival_.arm;
    Square M = pin::crba(rival_.model, rival_.data, in(s.q), pin::Convention::LOCAL);
    M.triangularView<Eigen::StrictlyLower>() = M.transpose();
    const Factor factor(M);
    const double h = s.dt / steps_;
    Vector injected = Vector::Zero();
    for (int k = 0; k < steps_; ++k) {
      Vector a1, a2, b1, b2, c1, c2, d1, d2, za, zb, zc, zd;
      rate(s, factor, x1_, x2_, a1, a2, za);
      rate(s, factor, x1_ + 0.5 * h * a1, x2_ + 0.5 * h * a2, b1, b2, zb);
      rate(s, factor, x1_ + 0.5 * h * b1, x2_ + 0.5 * h * b2, c1, c2, zc);
      rate(s, factor, x1_ + h * c1, x2_ + h * c2, d1, d2, zd);
      x1_ += h / 6.0 * (a1 + 2.0 * b1 + 2.0 * c1 + d1);
      x2_ += h / 6.0 * (a2 + 2.0 * b2 + 2.0 * c2 + d2);
      injected += h / 6.0 * (za + 2.0 * zb + 2.0 * zc + zd);
    }
    const Vector z2 = injected / s.dt;
    side_ += -std::expm1(-s.dt / 0.25) * (z2 / config_.alpha - side_);
    saturated_ = (side_.array().abs() > 0.95).any();
    JointVector z{};
    Eigen::Map<Vector>(z.data()) = z2;
    if (!((in(s.q) - x1_).array().abs() < 0.5).all() || !x2_.allFinite()) {
      x1_ = in(s.q);
      x2_.setZero();
    }
    low_pass_.step(z, s.dt);
    const double spread = config_.alpha * s.dt * config_.cutoff;
    torque_.noalias() = M * in(low_pass_.value());
    std_ = spread * spread * M.cwiseAbs2().rowwise().sum();
    for (int j = 0; j < N; ++j) {
      const double friction = arm.joint(j).friction.uncertainty(x2_[j], config_.friction_fraction);
      std_[j] = std::sqrt(std_[j] + arm.torque_variance(j) + friction * friction);
    }
  }
  Numbers numbers() const {
    Numbers out;
    out.add(torque_, N);
    out.add(std_, N);
    out.add(x1_, N);
    out.add(x2_, N);
    return out;
  }

 private:
  void rate(const JointSample& s, const Factor& factor, const Vector& x1, const Vector& x2, Vector& dx1, Vector& dx2, Vector& z2) {
    dx2 = in(s.tau) - pin::nonLinearEffects(rival_.model, rival_.data, in(s.q), x2);
    for (int j = 0; j < N; ++j) {
      const double e = s.q[u(j)] - x1[j], sign = std::tanh(e / (2.0 * config_.gamma));
      dx1[j] = x2[j] + config_.lambda * std::sqrt(std::abs(e)) * sign;
      z2[j] = config_.alpha * sign;
      dx2[j] -= rival_.arm.joint(j).friction.torque(x2[j]);
    }
    factor.solveInPlace(dx2);
    dx2 += z2;
  }

  Rival rival_;
  palpate::SlidingModeConfig config_;
  int steps_;
  palpate::HeldButterworth<> low_pass_;
  bool started_ = false, saturated_ = false;
  Vector x1_ = Vector::Zero(), x2_ = Vector::Zero(), side_ = Vector::Zero(), torque_ = Vector::Zero(), std_ = Vector::Zero();
};

/// The ways to run a filter, each timed.
template <template <Derivatives, Update> class Filter, class... Args>
void enter_filters(contest::Entries* entries, const palpate::ArmDescription& arm, Args... args) {
  using enum Derivatives;
  using enum Update;
  const auto enter = [&]<class Work>(std::type_identity<Work>, const char* how) {
    entries->push_back(std::make_unique<contest::Timed<Work>>(how, arm, args...));
  };
  enter(std::type_identity<Filter<newton_euler, one_by_one>>{}, "computeRNEADerivatives, one by one");
  enter(std::type_identity<Filter<newton_euler, all_at_once>>{}, "computeRNEADerivatives, all at once");
  enter(std::type_identity<Filter<articulated_body, one_by_one>>{}, "computeABADerivatives, one by one");
  enter(std::type_identity<Filter<articulated_body, all_at_once>>{}, "computeABADerivatives, all at once");
}

template <Derivatives d, Update u>
using Smoother = rival::ExtendedKalman<false, d, u>;
template <Derivatives d, Update u>
using Observer = rival::ExtendedKalman<true, d, u>;
/// The payload filter's sizes for what an arm has.
template <int loads, bool torques, bool encoders>
struct Sizes {
  template <Derivatives d, Update u>
  using Filter = rival::PayloadFilter<loads, torques, encoders, d, u>;
};

template <int loads>
void enter_payload_filters(contest::Entries* entries, const palpate::ArmDescription& arm) {
  bool torques = false, encoders = false;
  for (int i = 0; i < arm.n; ++i) {
    torques = torques || arm.joints[u(i)].friction.uncertainty(0.0, 0.0) > 0.0;
    encoders = encoders || arm.joints[u(i)].position_resolution > 0.0;
  }
  const double prior = contest::mass_prior_std;
  if (torques && encoders) enter_filters<Sizes<loads, true, true>::template Filter>(entries, arm, prior);
  else if (torques) throw std::invalid_argument("no rival for an arm with dry friction and exact encoders");
  else if (encoders) enter_filters<Sizes<loads, false, true>::template Filter>(entries, arm, prior);
  else enter_filters<Sizes<loads, false, false>::template Filter>(entries, arm, prior);
}

}  // namespace

/// The rival's ways of doing a job, each timed.
extern "C" void PALPATE_RIVAL(const palpate::ArmDescription* arm, Job job, contest::Entries* entries) {
  const auto enter = [&]<class Work>(std::type_identity<Work>, const char* how, auto... more) {
    entries->push_back(std::make_unique<contest::Timed<Work>>(how, *arm, more...));
  };
  switch (job) {
    case Job::momentum:
      enter(std::type_identity<Momentum<TermsByMatrices>>{}, "crba, computeCoriolisMatrix, computeGeneralizedGravity");
      enter(std::type_identity<Momentum<TermsByNewtonEuler>>{}, "rnea, computeCoriolisMatrix, computeGeneralizedGravity");
      enter(std::type_identity<Momentum<TermsByOwnSweep>>{}, "by hand: one sweep on forwardKinematics");
      break;
    case Job::sliding_mode: enter(std::type_identity<SlidingMode>{}, "crba, 4 nonLinearEffects, LLT", 1); break;
    case Job::sliding_mode_twice: enter(std::type_identity<SlidingMode>{}, "crba, 8 nonLinearEffects, LLT", 2); break;
    case Job::kalman: enter_filters<Smoother>(entries, *arm); break;
    case Job::kalman_disturbance: enter_filters<Observer>(entries, *arm); break;
    case Job::payload_mass: enter_payload_filters<1>(entries, *arm); break;
    case Job::payload_moment: enter_payload_filters<4>(entries, *arm); break;
    case Job::inverse_dynamics: enter(std::type_identity<InverseDynamics>{}, "rnea"); break;
    case Job::mass_matrix: enter(std::type_identity<MassMatrix>{}, "crba"); break;
    case Job::forward_dynamics:
      enter(std::type_identity<ForwardDynamics>{}, "aba");
      enter(std::type_identity<ForwardDynamicsByCholesky>{}, "crba, nonLinearEffects, LLT");
      break;
  }
}
