// The rival's dynamics: Pinocchio behind fixed-size Eigen types, so that its headers are compiled in one place only.
#pragma once
#include <Eigen/Dense>
#include <cstddef>
#include <memory>

#include "palpate/chain.hpp"

namespace rival {

constexpr int N = 7;
using Vector = Eigen::Matrix<double, N, 1>;
using Square = Eigen::Matrix<double, N, N>;
using VectorView = Eigen::Map<const Vector>;
using SquareView = Eigen::Map<const Square>;
using Factor = Eigen::LLT<Square, Eigen::Upper>;

inline std::size_t u(int i) { return static_cast<std::size_t>(i); }
inline Vector in(const palpate::JointVector& x) { return VectorView(x.data()); }
inline Eigen::Vector3d vector3(const palpate::Vec3<double>& a) { return {a.x, a.y, a.z}; }

/// An arm of seven revolute joints in Pinocchio. Each member is one of its algorithms (the name is said) and returns a view
/// that lives until the next call.
class Dynamics {
 public:
  explicit Dynamics(const palpate::Arm& arm);
  ~Dynamics();

  VectorView gravity(const Vector& q);                                            ///< computeGeneralizedGravity
  VectorView bias(const Vector& q, const Vector& dq);                             ///< nonLinearEffects
  VectorView inverse(const Vector& q, const Vector& dq, const Vector& ddq);       ///< rnea
  VectorView forward(const Vector& q, const Vector& dq, const Vector& tau);       ///< aba
  SquareView mass_matrix(const Vector& q);                                        ///< crba; the upper triangle
  SquareView coriolis(const Vector& q, const Vector& dq);                         ///< computeCoriolisMatrix
  /// palpate's sweep for p, C^T q' and g, by hand on forwardKinematics and Pinocchio's spatial types.
  void momentum_terms(const Vector& q, const Vector& dq, Vector& p, Vector& Ct_dq, Vector& g);

  /// computeABADerivatives with `armature` beside the rotors': q'' and its derivatives; also fills body_torque().
  VectorView forward_derivatives(const Vector& q, const Vector& dq, const Vector& tau, const Vector& armature, Square& by_q,
                                 Square& by_dq, Square& inverse_inertia);
  /// The body on the last link from now on, about the link's origin.
  void carry(const palpate::Inertia<double>& load);
  /// Joint torques of a body on the last link at q'' = 0, at the pose of the last mass_matrix(); about the link's origin.
  Vector bias_torque(const palpate::Inertia<double>& body, const Vector& dq) const;
  /// Joint torques of a body on the last link, at the last forward_derivatives(); base axes, about the base origin.
  Vector body_torque(const palpate::Inertia<double>& body) const;
  /// Placement of the last link, at the last forward_derivatives().
  palpate::Pose<double> last_pose() const;

 private:
  struct Pinocchio;
  std::unique_ptr<Pinocchio> p_;
};

}  // namespace rival
