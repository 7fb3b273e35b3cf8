// The rival's extended Kalman and payload filters: the same sources, with their heart replaced.
//
// palpate's ExtendedKalman and PayloadFilter rest on JointKalman and BaseFrame. Here they are compiled once more, on
// rival::JointKalman below: the same equations by Pinocchio's computeABADerivatives and Eigen's fixed-size matrices. All that
// is not dynamics or matrix algebra is thus the same text. Measured velocities, which the benchmark has none of, are left out.
//
// Other ways were tried and are slower: crba, nonLinearEffects, LLT and computeRNEADerivatives (by 0.7 us); one update by all
// seven positions instead of seven rank-one updates (by 0.7 us); lazy products; updating the whole covariance instead of a
// triangle.
//
// Both sides have the same flags. With -march=native (AVX) the payload filters here gain 15 to 20 % and then beat a palpate
// without it (7.5 beside 9.2 us, kuka_lbr_iiwa14, m); palpate gains as much and with it on both sides stays ahead (7.2 us).
#include <algorithm>
#include <cmath>
#include <memory>
#include <stdexcept>
#include <type_traits>

#include "contest.hpp"
#include "palpate/check.hpp"
#include "palpate/kalman.hpp"
#include "palpate/payload.hpp"
#include "rival.hpp"

namespace rival {

/// What the filters ask of the chain at the predicted point.
class Frame {
 public:
  explicit Frame(const Dynamics& dynamics) : dynamics_(dynamics), pose_(dynamics.last_pose()) {}
  const palpate::Pose<double>& pose() const { return pose_; }
  palpate::JointVector body_torque(int, const palpate::Inertia<double>& body) const {
    return rival::out(dynamics_.body_torque(body));
  }

 private:
  const Dynamics& dynamics_;
  palpate::Pose<double> pose_;
};

/// The interface of palpate::JointKalman for arms of seven joints.
template <int max_parameters>
class JointKalman {
 public:
  static constexpr int max_dim = palpate::JointKalman<max_parameters>::max_dim;
  using Parameters = typename palpate::JointKalman<max_parameters>::Parameters;
  using Input = typename palpate::JointKalman<max_parameters>::Input;

  JointKalman(int, int loads, bool torques, bool encoders)
      : loads_(loads), torques_(torques), encoders_(encoders), k_(loads + (torques ? N : 0) + (encoders ? N : 0)), dim_(2 * N + k_) {
    if (loads > 0 && !encoders) throw std::invalid_argument("the rival's payload filter is made for encoders of finite resolution");
  }

  int dim() const { return dim_; }
  double q(int i) const { return x_[u(i)]; }
  double dq(int i) const { return x_[u(N + i)]; }
  double parameter(int i) const { return x_[u(2 * N + i)]; }
  double variance(int i) const { return P_[u(i * dim_ + i)]; }
  double covariance(int r, int c) const { return P_[u(std::max(r, c) * dim_ + std::min(r, c))]; }  // the upper triangle, by columns
  double parameter_variance(int i) const { return variance(2 * N + i); }
  palpate::JointVector positions() const { return slice(0); }
  palpate::JointVector velocities() const { return slice(N); }
  const palpate::JointVector& acceleration() const { return acceleration_; }
  const palpate::JointVector& damping() const { return damping_; }
  palpate::JointMatrix mass() const {
    palpate::JointMatrix out{};
    for (int i = 0; i < N; ++i)
      for (int j = 0; j < N; ++j) out(i, j) = W_(i, j);
    return out;
  }
  palpate::JointVector torque_of(const palpate::JointVector& dq, const palpate::JointVector& ddq, double h) const {
    const Vector torque = W_ * rival::in(ddq) + rival::in(damping_).cwiseProduct(rival::in(dq));
    return rival::out(torque / h);
  }

  void set(int i, double mean, double var) {
    x_[u(i)] = mean;
    for (int c = 0; c < dim_; ++c) P_[u(c * dim_ + i)] = P_[u(i * dim_ + c)] = 0.0;
    P_[u(i * dim_ + i)] = var;
  }
  void set_parameter(int i, double mean, double var) { set(2 * N + i, mean, var); }
  void add_parameter_variance(int i, double var) { P_[u((2 * N + i) * dim_ + 2 * N + i)] += var; }
  palpate::Friction expected_friction(const palpate::Arm& arm, int i) const {
    palpate::Friction friction = arm.joint(i).friction;
    friction.sign_velocity = std::sqrt(friction.sign_velocity * friction.sign_velocity + std::max(variance(N + i), 0.0));
    return friction;
  }
  bool healthy() const {
    for (int i = 0; i < dim_; ++i)
      if (!std::isfinite(x_[u(i)]) || !(variance(i) >= 0.0) || !std::isfinite(variance(i))) return false;
    return true;
  }
  void add_direction(const std::array<double, static_cast<std::size_t>(max_dim)>& e, double m, double v) {
    for (int c = 0; c < dim_; ++c) {
      x_[u(c)] += m * e[u(c)];
      for (int r = 0; r < dim_; ++r) P_[u(c * dim_ + r)] += v * e[u(r)] * e[u(c)];
    }
  }
  void start(const palpate::Arm& arm, const palpate::JointSample& s, double velocity_std) {
    if (!dynamics_) dynamics_ = std::make_shared<Dynamics>(arm);
    for (int i = 0; i < N; ++i) {
      set(i, s.q[u(i)], std::max(arm.position_variance(i), least_variance));
      if (encoders_) {
        const int e = dim_ - N + i;
        rounded_at_[u(i)] = s.q[u(i)];
        set(e, 0.0, encoder_variance(arm, i));
        P_[u(i * dim_ + e)] = P_[u(e * dim_ + i)] = -encoder_variance(arm, i);
      }
      set(N + i, 0.0, velocity_std * velocity_std);
    }
  }

  template <class Columns>
  void predict(const palpate::Arm& arm, const Input& in, double h, Columns&& columns) {
    with_sizes([&](auto loads, auto torques, auto encoders) { predict<loads, torques, encoders>(arm, in, h, columns); });
  }

  void propagate(std::array<double, static_cast<std::size_t>(max_dim)>& e) const {
    with_sizes([&](auto loads, auto torques, auto encoders) {
      constexpr int k = loads + (torques ? N : 0) + (encoders ? N : 0), D = 2 * N + k, A = D - (encoders ? N : 0);
      Eigen::Map<Eigen::Matrix<double, D, 1>> x(e.data());
      const Eigen::Map<const Eigen::Matrix<double, A, N, Eigen::RowMajor>> Xt(Xt_.data());
      const Vector g = Xt.transpose() * x.template head<A>();
      x.template head<N>() += h_ * x.template segment<N>(N) + ht_.cwiseProduct(g);
      x.template segment<N>(N) += g;
      for (int p = 0; p < k; ++p) x[2 * N + p] *= decay_[u(p)];
    });
  }

  using Update = typename palpate::JointKalman<max_parameters>::Update;
  Update measure(int i, int e, double z, double R) {
    Update update{};
    with_sizes([&](auto loads, auto torques, auto encoders) {
      update = measure_upper<2 * N + loads + (torques ? N : 0) + (encoders ? N : 0)>(i, e, z, R);
    });
    return update;
  }
  using Innovation = typename palpate::JointKalman<max_parameters>::Innovation;
  Innovation innovation(const palpate::Arm& arm, const palpate::JointSample& sample, int i) const {
    Innovation out{sample.q[u(i)] - q(i), variance(i) + std::max(arm.position_variance(i), least_variance)};
    if (encoders_) {
      const int e = dim_ - N + i;
      out.y -= x_[u(e)];
      out.s += 2.0 * covariance(i, e) + variance(e);
    }
    return out;
  }
  template <class Seen>
  void measure_joints(const palpate::Arm& arm, const palpate::JointSample& s, Seen&& seen) {
    with_sizes([&](auto loads, auto torques, auto encoders) {
      constexpr int D = 2 * N + loads + (torques ? N : 0) + (encoders ? N : 0);
      for (int i = 0; i < N; ++i) {
        const int e = encoders ? D - N + i : -1;
        seen(i, e, measure_upper<D>(i, e, s.q[u(i)], std::max(arm.position_variance(i), least_variance)));
      }
    });
  }

 private:
  static constexpr double least_variance = 1e-16;

  /// On the upper triangle of P.
  template <int D>
  Update measure_upper(int i, int e, double z, double R) {
    Eigen::Map<Eigen::Matrix<double, D, 1>> x(x_.data()), K(K_.data());
    Eigen::Map<Eigen::Matrix<double, D, D>> P(P_.data());
    Eigen::Matrix<double, D, 1> p = column<D>(P, i);
    double y = z - x[i];
    if (e >= 0) {
      p += column<D>(P, e);
      y -= x[e];
    }
    const double S = p[i] + (e >= 0 ? p[e] : 0.0) + R;
    K = p / S;
    p /= std::sqrt(S);
    for (int c = 0; c < D; ++c) P.col(c).head(c + 1) -= p[c] * p.head(c + 1);
    x += K * y;
    return {y, S, K_.data()};
  }

  /// The sizes as constants: those that the benchmark's arms have.
  template <class F>
  void with_sizes(F&& f) const {
    using std::bool_constant, std::integral_constant;
    if constexpr (max_parameters == palpate::max_joints) {
      if (torques_) f(integral_constant<int, 0>{}, std::true_type{}, std::false_type{});
      else f(integral_constant<int, 0>{}, std::false_type{}, std::false_type{});
    } else {
      const auto with_loads = [&](auto loads) {
        if (torques_) f(loads, std::true_type{}, std::true_type{});
        else f(loads, std::false_type{}, std::true_type{});
      };
      if (loads_ == 1) with_loads(integral_constant<int, 1>{});
      else with_loads(integral_constant<int, 4>{});
    }
  }
  template <int D, class Matrix>
  static Eigen::Matrix<double, D, 1> column(const Matrix& P, int i) {
    Eigen::Matrix<double, D, 1> out;
    out.head(i + 1) = P.col(i).head(i + 1);
    out.tail(D - i - 1) = P.row(i).tail(D - i - 1);
    return out;
  }

  template <int loads, bool torques, bool encoders, class Columns>
  void predict(const palpate::Arm& arm, const Input& in, double h, Columns&& columns) {
    constexpr int torque = loads, encoder = loads + (torques ? N : 0), k = encoder + (encoders ? N : 0), D = 2 * N + k, P0 = 2 * N;
    constexpr int A = D - (encoders ? N : 0);
    Eigen::Map<Eigen::Matrix<double, D, 1>> x(x_.data());
    Eigen::Map<Eigen::Matrix<double, D, D>> P(P_.data());
    const Vector v = x.template segment<N>(N), q_m = x.template head<N>() + 0.5 * h * v;
    if constexpr (loads > 0) dynamics_->carry(in.load);
    const Square M = dynamics_->mass_matrix(q_m);
    Vector given = rival::in(in.tau), slope, armature, theta;
    if constexpr (torques) given += x.template segment<N>(P0 + torque);
    if (in.load_rest.m != 0.0 || in.load_rest.mc.x != 0.0 || in.load_rest.mc.y != 0.0 || in.load_rest.mc.z != 0.0)
      given -= dynamics_->bias_torque(in.load_rest, q_m, v);
    for (int i = 0; i < N; ++i) {
      const palpate::Friction friction = expected_friction(arm, i);
      slope[i] = std::max(friction.derivative(v[i]), 0.0);
      given[i] -= friction.torque(v[i]);
      theta[i] = weight(h * slope[i] / M(i, i));
      armature[i] = h * theta[i] * slope[i];
    }
    damping_ = rival::out(slope);
    W_ = M;
    W_.diagonal() += armature;
    Square by_q, by_dq, Noise;
    const Vector ddq = dynamics_->forward_derivatives(q_m, v, given, armature, by_q, by_dq, Noise);
    acceleration_ = rival::out(ddq);
    Noise *= h;
    Eigen::Map<Eigen::Matrix<double, A, N, Eigen::RowMajor>> Xt(Xt_.data());
    Xt.template topRows<N>() = h * by_q.transpose();
    Xt.template middleRows<N>(N) = (h * (by_dq + 0.5 * h * by_q) - Noise * slope.asDiagonal()).transpose();
    if constexpr (loads > 0) {
      Eigen::Matrix<double, N, loads, loads == 1 ? Eigen::ColMajor : Eigen::RowMajor> columns_of_load;
      columns(Frame(*dynamics_), columns_of_load.data(), loads);
      Xt.template middleRows<loads>(P0).noalias() = -(Noise * columns_of_load).transpose();
    }
    if constexpr (torques) Xt.template middleRows<N>(P0 + torque) = Noise;

    h_ = h;
    ht_ = h * theta;
    x.template head<N>() += h * (v + ht_.cwiseProduct(ddq));
    x.template segment<N>(N) += h * ddq;
    decay_ = in.decay;
    if constexpr (encoders)
      for (int i = 0; i < N; ++i) decay_[u(encoder + i)] = rounding_decay(arm, i);
    for (int p = 0; p < k; ++p) x[P0 + p] *= decay_[u(p)];

    // T = P F^T, of which the columns of q and q' are needed; then the upper triangle of F T. F = 1 + [0 h 0; 0 0 0; 0 0 phi-1]
    // + [h Theta; 1; 0] X.
    P.template triangularView<Eigen::StrictlyLower>() = P.transpose();
    Eigen::Matrix<double, D, N> G;
    G.noalias() = P.template leftCols<A>() * Xt;
    Eigen::Matrix<double, D, 2 * N> T;
    T.template leftCols<N>() = P.template leftCols<N>() + h * P.template middleCols<N>(N) + G * ht_.asDiagonal();
    T.template rightCols<N>() = P.template middleCols<N>(N) + G;
    Eigen::Matrix<double, N, 2 * N> H;
    H.noalias() = Xt.transpose() * T.template topRows<A>();
    P.template block<N, 2 * N>(0, 0) = T.template topRows<N>() + h * T.template middleRows<N>(N) + ht_.asDiagonal() * H;
    P.template block<N, N>(N, N) = T.template block<N, N>(N, N) + H.template rightCols<N>();
    for (int p = 0; p < k; ++p) {
      P.col(P0 + p).template head<2 * N>() = decay_[u(p)] * T.row(P0 + p).transpose();
      for (int o = 0; o <= p; ++o) P(P0 + o, P0 + p) *= decay_[u(o)] * decay_[u(p)];
    }
    const Square S = Noise * rival::in(in.torque_variance).asDiagonal() * Noise;
    P.template block<N, N>(0, 0) += ht_.asDiagonal() * S * ht_.asDiagonal() + h * h / 12.0 * S;
    P.template block<N, N>(0, N) += ht_.asDiagonal() * S;
    P.template block<N, N>(N, N) += S;
    if constexpr (encoders)
      for (int i = 0; i < N; ++i) {
        const double phi = decay_[u(encoder + i)];
        P(P0 + encoder + i, P0 + encoder + i) += (1.0 - phi * phi) * encoder_variance(arm, i);
      }
  }

  static double weight(double w) {
    if (w < 1e-2) return 0.5 + w / 12.0 - w * w * w / 720.0;
    return 1.0 / (1.0 - std::exp(-w)) - 1.0 / w;
  }
  static double encoder_variance(const palpate::Arm& arm, int i) {
    return arm.joint(i).position_resolution * arm.joint(i).position_resolution / 12.0;
  }
  double rounding_decay(const palpate::Arm& arm, int i) {
    const double count = arm.joint(i).position_resolution, moved = std::abs(q(i) - rounded_at_[u(i)]);
    if (moved < 0.25 * count) return 1.0;
    rounded_at_[u(i)] = q(i);
    return count > 0.0 ? std::exp(-moved / (0.2 * count)) : 0.0;
  }
  palpate::JointVector slice(int first) const {
    palpate::JointVector out{};
    std::copy_n(x_.begin() + first, N, out.begin());
    return out;
  }

  std::shared_ptr<Dynamics> dynamics_;
  int loads_;
  bool torques_, encoders_;
  int k_, dim_;
  double h_ = 0.0;
  Vector ht_ = Vector::Zero();  // h Theta
  palpate::JointVector acceleration_{}, damping_{}, rounded_at_{};
  Square W_ = Square::Zero();
  Parameters decay_{};
  std::array<double, static_cast<std::size_t>(max_dim)> x_{}, K_{};
  std::array<double, static_cast<std::size_t>(max_dim* max_dim)> P_{};                // by columns, dim_ x dim_
  std::array<double, static_cast<std::size_t>(max_dim* palpate::max_joints)> Xt_{};  // X^T by rows
};

}  // namespace rival

// The same text on another heart, under other names.
namespace palpate {
template <int max_parameters>
using RivalKalman = rival::JointKalman<max_parameters>;
using RivalFrame = rival::Frame;
}  // namespace palpate
#define JointKalman RivalKalman
#define BaseFrame RivalFrame
#define ExtendedKalman RivalExtendedKalman
#define PayloadFilter RivalPayloadFilter
#include "palpate/observers/extended_kalman.hpp"
#include "palpate/payload_filter.hpp"
#undef JointKalman
#undef BaseFrame
#undef ExtendedKalman
#undef PayloadFilter

/// The filter for a job.
std::unique_ptr<contest::Entry> rival_filter(const palpate::ArmDescription& arm, contest::Job job) {
  using contest::Job, contest::Timed;
  using Kalman = Timed<contest::Observing<palpate::RivalExtendedKalman>>;
  using Weighing = Timed<contest::Weighing<palpate::RivalPayloadFilter>>;
  constexpr const char* how = "crba, computeABADerivatives, Eigen";
  switch (job) {
    case Job::kalman: return std::make_unique<Kalman>(how, arm, contest::smoother<palpate::ExtendedKalmanConfig>());
    case Job::kalman_disturbance: return std::make_unique<Kalman>(how, arm, palpate::ExtendedKalmanConfig{});
    case Job::payload_mass: return std::make_unique<Weighing>(how, arm, contest::weigher<palpate::PayloadFilterConfig>(false));
    case Job::payload_moment: return std::make_unique<Weighing>(how, arm, contest::weigher<palpate::PayloadFilterConfig>(true));
    default: return nullptr;
  }
}
