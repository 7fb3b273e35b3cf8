// The rival's extended Kalman and payload filters: kalman.hpp and payload_filter.hpp on Pinocchio and Eigen.
//
// Two ways to the linearised dynamics and two ways to update are tried, so that the better one can win:
// - NewtonEuler: crba, nonLinearEffects, LLT, computeRNEADerivatives, solutions with the factor;
//   ArticulatedBody: crba (for the friction weights), then computeABADerivatives with the friction's share of W as armature;
// - OneByOne: a rank-one update per position; AllAtOnce: one update by seven positions with a 7 x 7 factor (the same gain,
//   since the positions' noises are independent).
#pragma once
#include "palpate/observers/extended_kalman.hpp"
#include "palpate/payload_filter.hpp"
#include "rival.hpp"

namespace rival {

enum class Derivatives { newton_euler, articulated_body };
enum class Update { one_by_one, all_at_once };

/// JointKalman<...> for 7 joints, sizes fixed.
template <int Loads, bool Torques, bool Encoders, Derivatives derivatives, Update update>
class Kalman : public Rival {
 public:
  static constexpr int torque = Loads, encoder = Loads + (Torques ? N : 0), K = encoder + (Encoders ? N : 0);
  static constexpr int D = 2 * N + K, A = 2 * N + encoder, P0 = 2 * N;  // P0: first parameter
  using State = Eigen::Matrix<double, D, 1>;
  using Covariance = Eigen::Matrix<double, D, D>;
  using Parameters = Eigen::Matrix<double, K, 1>;
  using Wrenches = Eigen::Matrix<double, 6, Loads>;
  static constexpr double least_variance = 1e-16;

  using Rival::Rival;

  State x = State::Zero();
  Covariance P = Covariance::Zero();
  Vector acceleration = Vector::Zero(), diagonal = Vector::Zero();  // q'', diagonal of W
  Vector tau = Vector::Zero();

  void set(int i, double mean, double variance) {
    x[i] = mean;
    P.row(i).setZero();
    P.col(i).setZero();
    P(i, i) = variance;
  }
  double encoder_variance(int i) const { return arm.joint(i).position_resolution * arm.joint(i).position_resolution / 12.0; }

  void start(const JointSample& s, double velocity_std) {
    for (int i = 0; i < N; ++i) {
      set(i, s.q[u(i)], std::max(arm.position_variance(i), least_variance));
      if constexpr (Encoders) {
        rounded_at_[i] = s.q[u(i)];
        set(P0 + encoder + i, 0.0, encoder_variance(i));
        P(i, P0 + encoder + i) = P(P0 + encoder + i, i) = -encoder_variance(i);
      }
      set(N + i, 0.0, velocity_std * velocity_std);
    }
  }

  /// `unit_wrenches(acceleration of the last link's origin, A3, W)`: force and moment in the last link's axes per unit of each
  /// load parameter; A3 r is what a point at r accelerates more than the origin. `rest`: wrench of the body whose weight acts
  /// only, or nullptr.
  template <class UnitWrenches>
  void predict(double h, const Vector& variance, const Parameters& decay, const palpate::Inertia<double>* rest, UnitWrenches&& unit_wrenches) {
    const Vector v = x.template segment<N>(N);
    const Vector q_m = x.template head<N>() + 0.5 * h * v;
    Vector rest_torque = Vector::Zero();
    Vector given = tau;
    if constexpr (Torques) given += x.template segment<N>(P0 + torque);
    Vector slope;
    for (int i = 0; i < N; ++i) {
      palpate::Friction friction = arm.joint(i).friction;
      friction.sign_velocity = std::sqrt(friction.sign_velocity * friction.sign_velocity + std::max(P(N + i, N + i), 0.0));
      slope[i] = friction.derivative(v[i]);
      given[i] -= friction.torque(v[i]);
    }
    if constexpr (derivatives == Derivatives::newton_euler) {
      given -= pin::nonLinearEffects(model, data, q_m, v);
      if (rest != nullptr) given -= torque_at_rest(*rest);
      Square W = pin::crba(model, data, q_m, pin::Convention::LOCAL);
      for (int i = 0; i < N; ++i) {
        theta_[i] = weight(h * slope[i] / W(i, i));
        W(i, i) += h * theta_[i] * slope[i];
      }
      diagonal = W.diagonal();
      const Factor factor(W);
      acceleration = factor.solve(given);
      pin::computeRNEADerivatives(model, data, q_m, v, acceleration);
      X_.template leftCols<N>() = -h * data.dtau_dq;
      X_.template middleCols<N>(N) = -h * (data.dtau_dv + 0.5 * h * data.dtau_dq);
      X_.template middleCols<N>(N).diagonal() -= h * slope;
      if constexpr (Loads > 0) X_.template middleCols<Loads>(P0) = -h * load_columns(unit_wrenches);
      Noise_ = h * Square::Identity();
      factor.solveInPlace(Noise_);
      if constexpr (Torques) X_.template middleCols<N>(P0 + torque) = Noise_;
      auto solved = X_.template leftCols<P0 + Loads>();
      factor.solveInPlace(solved);
    } else {
      if (rest != nullptr) {
        pin::forwardKinematics(model, data, q_m, v, Vector::Zero());
        for (pin::JointIndex i = 1; i <= N; ++i) data.a_gf[i] = data.a[i] - data.oMi[i].actInv(model.gravity);
        given -= torque_at_rest(*rest);
      }
      pin::crba(model, data, q_m, pin::Convention::LOCAL);
      for (int i = 0; i < N; ++i) {
        theta_[i] = weight(h * slope[i] / data.M(i, i));
        model.armature[i] = arm.body(i).rotor_inertia + h * theta_[i] * slope[i];
        diagonal[i] = data.M(i, i) + h * theta_[i] * slope[i];
      }
      Square dq, dv, Minv;
      pin::computeABADerivatives(model, data, q_m, v, given, dq, dv, Minv);
      for (int i = 0; i < N; ++i) model.armature[i] = arm.body(i).rotor_inertia;
      acceleration = data.ddq;
      Noise_ = h * Minv;
      X_.template leftCols<N>() = h * dq;
      X_.template middleCols<N>(N) = h * (dv + 0.5 * h * dq) - Noise_ * slope.asDiagonal();
      if constexpr (Loads > 0) X_.template middleCols<Loads>(P0).noalias() = -Noise_ * load_columns(unit_wrenches);
      if constexpr (Torques) X_.template middleCols<N>(P0 + torque) = Noise_;
    }

    h_ = h;
    ht_ = h * theta_;
    x.template head<N>() += h * (v + ht_.cwiseProduct(acceleration));
    x.template segment<N>(N) += h * acceleration;
    if constexpr (K > 0) {
      decay_ = decay;
      if constexpr (Encoders)
        for (int i = 0; i < N; ++i) decay_[encoder + i] = rounding_decay(i);
      x.template tail<K>().array() *= decay_.array();
    }

    // P <- F P F^T, F = 1 + [0 h 0; 0 0 0; 0 0 phi-1] + [h Theta; 1; 0] X
    Eigen::Matrix<double, N, D> G;
    G.noalias() = X_ * P.template topRows<A>();
    Covariance T;
    T.template topRows<N>() = P.template topRows<N>() + h * P.template middleRows<N>(N) + ht_.asDiagonal() * G;
    T.template middleRows<N>(N) = P.template middleRows<N>(N) + G;
    if constexpr (K > 0) T.template bottomRows<K>() = decay_.asDiagonal() * P.template bottomRows<K>();
    Eigen::Matrix<double, D, N> H;
    H.noalias() = T.template leftCols<A>() * X_.transpose();
    P.template leftCols<N>() = T.template leftCols<N>() + h * T.template middleCols<N>(N) + H * ht_.asDiagonal();
    P.template middleCols<N>(N) = T.template middleCols<N>(N) + H;
    if constexpr (K > 0) P.template rightCols<K>() = T.template rightCols<K>() * decay_.asDiagonal();

    const Square S = Noise_ * variance.asDiagonal() * Noise_.transpose();
    P.template block<N, N>(N, N) += S;
    P.template block<N, N>(0, N) += ht_.asDiagonal() * S;
    P.template block<N, N>(N, 0) += S * ht_.asDiagonal();
    P.template block<N, N>(0, 0) += ht_.asDiagonal() * S * ht_.asDiagonal();
    if constexpr (Encoders)
      for (int i = 0; i < N; ++i) {
        const double phi = decay_[encoder + i];
        P(P0 + encoder + i, P0 + encoder + i) += (1.0 - phi * phi) * encoder_variance(i);
      }
    P.template triangularView<Eigen::StrictlyLower>() = P.transpose();
  }

  /// E <- F E for errors as columns.
  template <class Errors>
  void propagate(Errors& E) const {
    const Eigen::Matrix<double, N, Errors::ColsAtCompileTime> g = X_ * E.template topRows<A>();
    E.template topRows<N>() += h_ * E.template middleRows<N>(N) + ht_.asDiagonal() * g;
    E.template middleRows<N>(N) += g;
    if constexpr (K > 0) E.template bottomRows<K>() = decay_.asDiagonal() * E.template bottomRows<K>();
  }

  /// All positions. `seen(y, S, seen_of, K)` per update: innovation, its factor's whitening, rows of H, gain.
  template <class Seen>
  void measure(const JointSample& s, Seen&& seen) {
    const auto noise = [&](int i) { return std::max(arm.position_variance(i), least_variance); };
    if constexpr (update == Update::one_by_one) {
      for (int i = 0; i < N; ++i) {
        State p = P.col(i);
        double y = s.q[u(i)] - x[i];
        if constexpr (Encoders) {
          p += P.col(P0 + encoder + i);
          y -= x[P0 + encoder + i];
        }
        const double S = p[i] + (Encoders ? p[P0 + encoder + i] : 0.0) + noise(i);
        const State gain = p / S, left = p - S * gain;
        P.noalias() -= gain * p.transpose();
        P.noalias() -= left * gain.transpose();
        x += gain * y;
        const double root = std::sqrt(S);
        seen([&](const auto& E) { return rows(E, i); }, Eigen::Matrix<double, 1, 1>(y / root),
             [root](auto& rows_of_E) { rows_of_E /= root; }, gain);
      }
    } else {
      Eigen::Matrix<double, D, N> p = P.template leftCols<N>();
      if constexpr (Encoders) p += P.template rightCols<N>();
      Vector y = in(s.q) - x.template head<N>();
      Square S = p.template topRows<N>();
      if constexpr (Encoders) {
        y -= x.template tail<N>();
        S += p.template bottomRows<N>();
      }
      for (int i = 0; i < N; ++i) S(i, i) += noise(i);
      const Eigen::LLT<Square> factor(S);
      Eigen::Matrix<double, N, D> pt = p.transpose();
      factor.solveInPlace(pt);
      const Eigen::Matrix<double, D, N> gain = pt.transpose();
      const Eigen::Matrix<double, D, N> left = p - gain * S;
      P.noalias() -= gain * p.transpose();
      P.noalias() -= left * gain.transpose();
      x.noalias() += gain * y;
      factor.matrixL().solveInPlace(y);
      seen([](const auto& E) { return rows(E); }, y, [&factor](auto& rows_of_E) { factor.matrixL().solveInPlace(rows_of_E); }, gain);
    }
  }

 private:
  template <class Errors>
  static auto rows(const Errors& E, int i) {
    Eigen::Matrix<double, 1, Errors::ColsAtCompileTime> out = E.row(i);
    if constexpr (Encoders) out += E.row(P0 + encoder + i);
    return out;
  }
  template <class Errors>
  static auto rows(const Errors& E) {
    Eigen::Matrix<double, N, Errors::ColsAtCompileTime> out = E.template topRows<N>();
    if constexpr (Encoders) out += E.template bottomRows<N>();
    return out;
  }
  static double weight(double w) {
    if (w < 1e-2) return 0.5 + w / 12.0 - w * w * w / 720.0;
    return 1.0 / (1.0 - std::exp(-w)) - 1.0 / w;
  }
  double rounding_decay(int i) {
    const double count = arm.joint(i).position_resolution, moved = std::abs(x[i] - rounded_at_[i]);
    if (moved < 0.25 * count) return 1.0;
    rounded_at_[i] = x[i];
    return count > 0.0 ? std::exp(-moved / (0.2 * count)) : 0.0;
  }
  /// Joint torques of a body on the last link, from its velocity and acceleration in data.v and data.a_gf.
  Vector torque_at_rest(const palpate::Inertia<double>& body) {
    const pin::Inertia I = inertia(body);
    pin::Force f = I * data.a_gf[N] + data.v[N].cross(I * data.v[N]);
    Vector out;
    for (pin::JointIndex i = N; i > 0; --i) {
      out[static_cast<Eigen::Index>(i) - 1] = f.angular().z();
      f = data.liMi[i].act(f);
    }
    return out;
  }
  template <class UnitWrenches>
  Eigen::Matrix<double, N, Loads> load_columns(UnitWrenches&& unit_wrenches) const {
    const pin::Motion v = data.oMi[N].actInv(data.ov[N]), a = data.oMi[N].actInv(data.oa_gf[N]);
    const Eigen::Vector3d w = v.angular();
    const Eigen::Matrix3d A3 = pin::skew(a.angular()) + w * w.transpose() - w.squaredNorm() * Eigen::Matrix3d::Identity();
    Wrenches W;
    unit_wrenches(Eigen::Vector3d(a.linear() + w.cross(v.linear())), A3, W);
    for (int k = 0; k < Loads; ++k) W.col(k) = data.oMi[N].act(pin::Force(W.col(k))).toVector();
    return data.J.transpose() * W;
  }

  double h_ = 0.0;
  Vector theta_ = Vector::Zero(), ht_ = Vector::Zero(), rounded_at_ = Vector::Zero();
  Parameters decay_ = Parameters::Ones();
  Eigen::Matrix<double, N, A> X_ = Eigen::Matrix<double, N, A>::Zero();
  Square Noise_ = Square::Zero();
};

/// ExtendedKalman::step.
template <bool disturbance, Derivatives derivatives, Update update>
class ExtendedKalman {
 public:
  using Filter = Kalman<0, disturbance, false, derivatives, update>;
  explicit ExtendedKalman(const palpate::ArmDescription& description) : f_(description) {
    const double model = config_.model_torque_std;
    for (int i = 0; i < N; ++i) {
      variance_[i] = f_.arm.torque_variance(i) + model * model;
      if constexpr (disturbance) f_.set(Filter::P0 + i, 0.0, config_.disturbance_prior_std * config_.disturbance_prior_std);
    }
  }
  void step(const JointSample& s) {
    if (!started_) {
      f_.start(s, config_.velocity_prior_std);
      started_ = true;
      report();
      return;
    }
    f_.tau = in(s.tau);
    f_.predict(s.dt, variance_, Filter::Parameters::Ones(), nullptr, [](const auto&, const auto&, const auto&) {});
    if constexpr (disturbance)
      f_.P.diagonal().template tail<N>().array() += config_.disturbance_rate * config_.disturbance_rate * s.dt;
    f_.measure(s, [](const auto&...) {});
    report();
  }
  Numbers numbers() const {
    Numbers out;
    out.add(torque_, N);
    out.add(std_, N);
    for (int i = 0; i < 2 * N; ++i) out.add(f_.x[i]);
    return out;
  }

 private:
  void report() {
    if constexpr (disturbance)
      for (int i = 0; i < N; ++i) {
        const double friction = f_.arm.joint(i).friction.uncertainty(f_.x[N + i], config_.friction_fraction);
        torque_[i] = f_.x[Filter::P0 + i];
        std_[i] = std::sqrt(f_.P(Filter::P0 + i, Filter::P0 + i) + friction * friction);
      }
  }
  palpate::ExtendedKalmanConfig config_;
  Filter f_;
  Vector variance_ = Vector::Zero(), torque_ = Vector::Zero(), std_ = Vector::Zero();
  bool started_ = false;
};

/// PayloadFilter::step, for an arm with or without dry friction (Torques) and coarse encoders (Encoders).
template <int Loads, bool Torques, bool Encoders, Derivatives derivatives, Update update>
class PayloadFilter {
 public:
  using Filter = Kalman<Loads, Torques, Encoders, derivatives, update>;
  static constexpr int P0 = Filter::P0, D = Filter::D;

  PayloadFilter(const palpate::ArmDescription& description, double mass_prior_std)
      : f_(description), own_(f_.model.inertias[N]), c_(vector3(f_.arm.p_last_grasp())) {
    config_.mass_prior_std = mass_prior_std;
    const palpate::Mat3<double>& R = f_.arm.R_last_tip();
    axes_ << vector3(R.cx), vector3(R.cy), vector3(R.cz);
    for (int i = 0; i < N; ++i) variance_[i] = f_.arm.torque_variance(i) + config_.model_torque_std * config_.model_torque_std;
    decay_.setOnes();
    const double m = config_.mass_prior_std, c = config_.offset_prior_std * m;
    f_.set(P0, 0.0, m * m);
    for (int k = 1; k < Loads; ++k) f_.set(P0 + k, 0.0, c * c);
    restart_hypotheses();
  }

  void step(const JointSample& s) {
    if (!started_) {
      f_.start(s, config_.velocity_prior_std);
      if constexpr (Torques)
        for (int i = 0; i < N; ++i) f_.set(P0 + Loads + i, 0.0, bias_variance(i, f_.x[N + i]));
      started_ = true;
      restart_hypotheses();
      report();
      return;
    }
    predict(s, s.dt);
    f_.measure(s, [this](const auto& rows, const auto& whitened, const auto& whiten, const auto& gain) {
      const auto seen = rows(E_);
      auto white = seen;
      whiten(white);
      num_ += (whitened.transpose() * white).transpose();
      den_ += white.colwise().squaredNorm().transpose();
      E_.noalias() -= gain * seen;
    });
    look_for_change(s);
    report();
  }
  Numbers numbers() const {
    Numbers out;
    out.add(mass_);
    out.add(mass_std_);
    out.add(moment_, 3);
    out.add(moment_std_, 3);
    for (int i = 0; i < 2 * N; ++i) out.add(f_.x[i]);
    return out;
  }

 private:
  static constexpr int H = 8;  // hypotheses
  using Eight = Eigen::Matrix<double, H, 1>;

  double bias_variance(int i, double dq) const {
    const double std = f_.arm.joint(i).friction.uncertainty(dq, config_.friction_fraction);
    return std * std;
  }
  int regime(int i, double dq) const {
    const double v0 = f_.arm.joint(i).friction.sign_velocity;
    const double threshold = regime_[u(i)] == 0 ? 1.25 * v0 : 0.75 * v0;
    return dq > threshold ? 1 : dq < -threshold ? -1 : 0;
  }

  void predict(const JointSample& s, double h) {
    const double phi = std::exp(-h / config_.friction_time);
    if constexpr (Torques)
      for (int i = 0; i < N; ++i) {
        const double dq = f_.x[N + i];
        const int now = regime(i, dq);
        if (now != regime_[u(i)]) {
          regime_[u(i)] = now;
          f_.set(P0 + Loads + i, 0.0, bias_variance(i, dq));
        }
        decay_[Loads + i] = phi;
      }
    Vector variance = variance_;
    add_curvature(variance);

    // The load, and what is left when only its physical part may have inertia.
    const double m = f_.x[P0];
    Eigen::Vector3d moment = Eigen::Vector3d::Zero();
    if constexpr (Loads > 1) moment = axes_ * f_.x.template segment<3>(P0 + 1);
    const palpate::Inertia<double> load = body(m, moment);
    palpate::Inertia<double> real{};
    if (m > 0.0) {
      const double limit = 4.0 * config_.offset_prior_std * m, length = moment.norm();
      if (length > limit) moment *= limit / length;
      const Eigen::Vector3d c = c_ + moment / m;
      real = palpate::about_origin(m, {c.x(), c.y(), c.z()}, palpate::Sym3<double>{});
      f_.model.inertias[N] = own_ + pin::Inertia(m, c, pin::Symmetric3::Zero());
    } else {
      f_.model.inertias[N] = own_;
    }
    const palpate::Inertia<double> rest = load + (-1.0) * real;

    f_.tau = in(s.tau);
    f_.predict(h, variance, decay_, rest.m != 0.0 ? &rest : nullptr,
               [this](const Eigen::Vector3d& acceleration, const Eigen::Matrix3d& A3, typename Filter::Wrenches& W) {
                 const Eigen::Vector3d at_grasp = acceleration + A3 * c_;
                 W.col(0) << at_grasp, c_.cross(at_grasp);
                 if constexpr (Loads > 1)
                   for (int k = 0; k < 3; ++k) {
                     const Eigen::Vector3d e = axes_.col(k), f = A3 * e;
                     W.col(k + 1) << f, e.cross(at_grasp) + c_.cross(f);
                   }
               });
    if constexpr (Torques)
      for (int i = 0; i < N; ++i) f_.P(P0 + Loads + i, P0 + Loads + i) += (1.0 - phi * phi) * bias_variance(i, f_.x[N + i]);
    f_.propagate(E_);
    age_.array() += h;
  }

  /// m and the first moment beyond m c, about the last link's origin, as theta enters: linearly.
  palpate::Inertia<double> body(double m, const Eigen::Vector3d& moment) const {
    const palpate::Vec3<double> c{c_.x(), c_.y(), c_.z()}, d{moment.x(), moment.y(), moment.z()};
    palpate::Inertia<double> out = m * palpate::about_origin(1.0, c, palpate::Sym3<double>{});
    out.mc = out.mc + d;
    out.I = out.I + palpate::parallel_axis(d, c);
    return out;
  }

  void add_curvature(Vector& variance) {
    pin::forwardKinematics(f_.model, f_.data, f_.x.template head<N>());
    const Eigen::Vector3d c = f_.data.oMi[N].act(c_), g = f_.model.gravity.linear();
    const double mass_variance = f_.P(P0, P0);
    Eigen::Matrix<double, 3, N> J, axis;
    for (int j = 0; j < N; ++j) {
      axis.col(j) = f_.data.oMi[u(j) + 1].rotation().col(2);
      J.col(j) = axis.col(j).cross(c - f_.data.oMi[u(j) + 1].translation());
    }
    for (int j = 0; j < N; ++j)
      for (int i = 0; i <= j; ++i) {
        const double slope = axis.col(i).cross(J.col(j)).dot(g);
        variance[i] += mass_variance * slope * slope * f_.arm.position_variance(j);
        if (i != j) variance[j] += mass_variance * slope * slope * f_.arm.position_variance(i);
      }
    const Eigen::Vector3d a_c = J * f_.acceleration;
    for (int i = 0; i < N; ++i) {
      const double torque = J.col(i).dot(a_c), share = J.col(i).squaredNorm() / std::max(f_.diagonal[i], 1e-12);
      variance[i] += mass_variance * torque * torque * std::min(1.0, mass_variance * share * share);
    }
  }

  void restart_hypotheses() {
    E_.setZero();
    num_.setZero();
    den_.setZero();
    since_ = {};
    for (int i = 0; i < H; ++i) {
      life_[i] = i < 4 ? 0.24 : 1.0;
      age_[i] = life_[i] * (i % 4) / 4.0;
    }
  }
  void look_for_change(const JointSample& s) {
    int best = -1;
    double best_score = config_.change_threshold * config_.change_threshold;
    for (int i = 0; i < H; ++i) {
      if (!(den_[i] > 0.0)) continue;
      const double score = num_[i] * num_[i] / den_[i];
      if (score > best_score && std::abs(num_[i] / den_[i]) >= config_.min_change) {
        best_score = score;
        best = i;
      }
    }
    if (best >= 0 && std::sqrt(std::max(f_.P(P0, P0), 0.0)) < config_.mass_prior_std / 3.0) {
      const double prior = config_.mass_prior_std, c = config_.offset_prior_std * prior;
      const Eigen::Matrix<double, D, 1> e = E_.col(best);
      f_.x += num_[best] / den_[best] * e;
      f_.P.noalias() += prior * prior * e * e.transpose();
      for (int k = 1; k < Loads; ++k) f_.P(P0 + k, P0 + k) += c * c;
      restart_hypotheses();
      return;
    }
    for (int i = 0; i < H; ++i)
      if (age_[i] >= life_[i]) {
        E_.col(i).setZero();
        E_(P0, i) = 1.0;
        num_[i] = den_[i] = age_[i] = 0.0;
        since_[u(i)] = s.time_ns;
      }
  }
  void report() {
    mass_ = f_.x[P0];
    mass_std_ = std::sqrt(std::max(f_.P(P0, P0), 0.0));
    for (int k = 1; k < Loads; ++k) {
      moment_[k - 1] = f_.x[P0 + k];
      moment_std_[k - 1] = std::sqrt(std::max(f_.P(P0 + k, P0 + k), 0.0));
    }
  }

  palpate::PayloadFilterConfig config_;
  Filter f_;
  pin::Inertia own_;     // of the bare last link
  Eigen::Vector3d c_;    // grasp point in the last link
  Eigen::Matrix3d axes_; // of the tip, in the last link
  Vector variance_ = Vector::Zero();
  typename Filter::Parameters decay_;
  std::array<int, N> regime_{};
  Eigen::Matrix<double, D, H> E_;
  Eight num_, den_, age_, life_;
  std::array<std::int64_t, H> since_{};
  bool started_ = false;
  double mass_ = 0.0, mass_std_ = 0.0;
  Eigen::Vector3d moment_ = Eigen::Vector3d::Zero(), moment_std_ = Eigen::Vector3d::Zero();
};

}  // namespace rival
