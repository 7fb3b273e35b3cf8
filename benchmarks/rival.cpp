// The rival's entries: the same observers and filters on Pinocchio's dynamics and Eigen's fixed-size matrices. What is neither
// (friction, low-pass) is palpate's own code.
#include "contest.hpp"
#include "palpate/observers/momentum.hpp"
#include "palpate/observers/sliding_mode.hpp"
#include "rival.hpp"

namespace {

using namespace rival;
using contest::Job;
using contest::Arm;
using contest::ArmDescription;
using contest::JointSample;
using contest::Numbers;

/// Everything a job needs of the arm.
struct Rival {
  explicit Rival(const ArmDescription& description) : arm(description), dynamics(arm) {}
  Arm arm;
  Dynamics dynamics;
};

// --- dynamics ----------------------------------------------------------------------------------------------------

struct InverseDynamics : Rival {
  using Rival::Rival;
  void step(const JointSample& s) { tau = dynamics.inverse(in(s.q), in(s.dq), in(s.tau)); }  // any numbers will do for q''
  Numbers numbers() const {
    Numbers out;
    out.add(tau, N);
    return out;
  }
  Vector tau;
};

struct MassMatrix : Rival {
  using Rival::Rival;
  void step(const JointSample& s) { M = dynamics.mass_matrix(in(s.q)); }
  Numbers numbers() const {
    Numbers out;
    for (int i = 0; i < N; ++i)
      for (int j = i; j < N; ++j) out.add(M(i, j));
    return out;
  }
  Square M;
};

struct ForwardDynamics : Rival {
  using Rival::Rival;
  void step(const JointSample& s) { ddq = dynamics.forward(in(s.q), in(s.dq), in(s.tau)); }
  Numbers numbers() const {
    Numbers out;
    out.add(ddq, N);
    return out;
  }
  Vector ddq;
};

/// The way palpate goes: mass matrix, bias, Cholesky.
struct ForwardDynamicsByCholesky : ForwardDynamics {
  using ForwardDynamics::ForwardDynamics;
  void step(const JointSample& s) {
    const Vector q = in(s.q);
    ddq = in(s.tau) - dynamics.bias(q, in(s.dq));
    Factor(dynamics.mass_matrix(q)).solveInPlace(ddq);
  }
};

// --- momentum observer -------------------------------------------------------------------------------------------

/// MomentumObserver::step with Eigen's vectors.
class Momentum : Rival {
 public:
  using Terms = void (Dynamics::*)(const Vector& q, const Vector& dq, Vector& p, Vector& Ct_dq, Vector& g);
  Momentum(const ArmDescription& description, Terms terms) : Rival(description), terms_(terms) {}
  void step(const JointSample& s) {
    Vector p, Ct_dq, g, beta;
    (dynamics.*terms_)(in(s.q), in(s.dq), p, Ct_dq, g);
    for (int j = 0; j < N; ++j) beta[j] = Ct_dq[j] - g[j] - arm.joint(j).friction.torque(s.dq[u(j)]);
    if (started_) {
      const double a = std::exp(-config_.bandwidth * s.dt), b = 1.0 - a;
      refresh_noise(s);
      r_ = a * r_ + b * ((p - p_) / s.dt - in(s.tau) - 0.5 * (beta + beta_));
      for (int j = 0; j < N; ++j) {
        const double friction = arm.joint(j).friction.uncertainty(s.dq[u(j)], config_.friction_fraction);
        std_[j] = std::sqrt(b / (1.0 + a) * arm.torque_variance(j) +
                            2.0 / (1.0 + a) * (b / s.dt) * (b / s.dt) * p_variance_[j] + friction * friction);
      }
    }
    p_ = p;
    beta_ = beta;
    started_ = true;
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
    const Square M = dynamics.mass_matrix(in(s.q)).selfadjointView<Eigen::Upper>();
    p_variance_ = M.cwiseAbs2() * in(s.dq_std).cwiseAbs2();
    noise_q_ = in(s.q);
  }
  Terms terms_;
  palpate::MomentumConfig config_;
  bool started_ = false;
  Vector p_ = Vector::Zero(), beta_ = Vector::Zero(), r_ = Vector::Zero(), std_ = Vector::Zero();
  Vector p_variance_ = Vector::Zero(), noise_q_ = Vector::Constant(1e9);
};

// --- sliding-mode observer ---------------------------------------------------------------------------------------

/// SlidingModeObserver::step with the Runge-Kutta solver; bias by nonLinearEffects, one mass matrix per sample.
class SlidingMode : Rival {
 public:
  SlidingMode(const ArmDescription& description, int substeps)
      : Rival(description),
        steps_(substeps),
        low_pass_(palpate::Butterworth::from_rad_per_s(config_.order, config_.cutoff), N, palpate::Start::zero) {}

  void step(const JointSample& s) {
    if (!started_) {
      x1_ = in(s.q);
      x2_.setZero();
      started_ = true;
      return;
    }
    const Square M = dynamics.mass_matrix(in(s.q)).selfadjointView<Eigen::Upper>();
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
    if (!((in(s.q) - x1_).array().abs() < 0.5).all() || !x2_.allFinite()) {
      x1_ = in(s.q);
      x2_.setZero();
    }
    palpate::JointVector z{};
    Eigen::Map<Vector>(z.data()) = z2;
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
    dx2 = in(s.tau) - dynamics.bias(in(s.q), x2);
    for (int j = 0; j < N; ++j) {
      const double e = s.q[u(j)] - x1[j], sign = std::tanh(e / (2.0 * config_.gamma));
      dx1[j] = x2[j] + config_.lambda * std::sqrt(std::abs(e)) * sign;
      z2[j] = config_.alpha * sign;
      dx2[j] -= arm.joint(j).friction.torque(x2[j]);
    }
    factor.solveInPlace(dx2);
    dx2 += z2;
  }

  palpate::SlidingModeConfig config_;
  int steps_;
  palpate::HeldButterworth<> low_pass_;
  bool started_ = false;
  Vector x1_ = Vector::Zero(), x2_ = Vector::Zero(), side_ = Vector::Zero(), torque_ = Vector::Zero(), std_ = Vector::Zero();
};

}  // namespace

std::unique_ptr<contest::Entry> rival_filter(const ArmDescription& arm, Job job);  // rival_kalman.cpp

/// The rival's ways of doing a job.
contest::Entries pinocchio_entries(const ArmDescription& arm, Job job) {
  contest::Entries entries;
  const auto enter = [&]<class Work>(std::type_identity<Work>, const char* how, auto... more) {
    entries.push_back(std::make_unique<contest::Timed<Work>>(how, arm, more...));
  };
  switch (job) {
    case Job::momentum:
      enter(std::type_identity<Momentum>{}, "computeGeneralizedGravity, rnea, computeCoriolisMatrix", &Dynamics::momentum_terms);
      enter(std::type_identity<Momentum>{}, "computeCoriolisMatrix and what it leaves", &Dynamics::momentum_terms_from_coriolis);
      break;
    case Job::sliding_mode: enter(std::type_identity<SlidingMode>{}, "crba, 4 nonLinearEffects, LLT", 1); break;
    case Job::sliding_mode_twice: enter(std::type_identity<SlidingMode>{}, "crba, 8 nonLinearEffects, LLT", 2); break;
    case Job::kalman:
    case Job::kalman_disturbance:
    case Job::payload_mass:
    case Job::payload_moment: entries.push_back(rival_filter(arm, job)); break;
    case Job::inverse_dynamics: enter(std::type_identity<InverseDynamics>{}, "rnea"); break;
    case Job::mass_matrix: enter(std::type_identity<MassMatrix>{}, "crba"); break;
    case Job::forward_dynamics:
      enter(std::type_identity<ForwardDynamics>{}, "aba");
      enter(std::type_identity<ForwardDynamicsByCholesky>{}, "crba, nonLinearEffects, LLT");
      break;
  }
  return entries;
}
