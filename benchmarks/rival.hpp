// The rival's dynamics between fixed-size Eigen types: Pinocchio, whose headers are compiled in rival_dynamics.cpp only.
#pragma once
#include <Eigen/Dense>
#include <cstddef>
#include <memory>

#include "palpate/chain.hpp"

namespace rival {

constexpr int N = 7;
using Vector = Eigen::Matrix<double, N, 1>;
using Square = Eigen::Matrix<double, N, N>;
using Factor = Eigen::LLT<Square, Eigen::Upper>;  // crba fills the upper triangle

inline std::size_t u(int i) { return static_cast<std::size_t>(i); }
inline Eigen::Map<const Vector> in(const palpate::JointVector& x) { return Eigen::Map<const Vector>(x.data()); }
inline palpate::JointVector out(const Vector& x) {
  palpate::JointVector values{};
  Eigen::Map<Vector>(values.data()) = x;
  return values;
}
inline Eigen::Vector3d vector3(const palpate::Vec3<double>& a) { return {a.x, a.y, a.z}; }

/// An arm of seven revolute joints. Each member is Pinocchio's algorithm of the name that is said.
class Dynamics {
 public:
  explicit Dynamics(const palpate::Arm& arm);
  ~Dynamics();

  Vector inverse(const Vector& q, const Vector& dq, const Vector& ddq);  ///< rnea
  Vector bias(const Vector& q, const Vector& dq);                        ///< nonLinearEffects
  Vector forward(const Vector& q, const Vector& dq, const Vector& tau);  ///< aba
  Square mass_matrix(const Vector& q);                                   ///< crba; the upper triangle

  /// p, C^T q' and g from computeGeneralizedGravity, rnea at q'' = q' (cheaper than crba and a product), computeCoriolisMatrix.
  void momentum_terms(const Vector& q, const Vector& dq, Vector& p, Vector& Ct_dq, Vector& g);
  /// The same from computeCoriolisMatrix alone: it leaves the joint axes J and, in Ag, the momentum of the bodies beyond each
  /// joint per unit of its speed.
  void momentum_terms_from_coriolis(const Vector& q, const Vector& dq, Vector& p, Vector& Ct_dq, Vector& g);

  /// computeABADerivatives with `armature` beside the rotors': q'' and its derivatives.
  Vector forward_derivatives(const Vector& q, const Vector& dq, const Vector& tau, const Vector& armature, Square& by_q, Square& by_dq,
                             Square& inverse_inertia);
  /// The body on the last link from now on, about the link's origin.
  void carry(const palpate::Inertia<double>& load);
  /// Joint torques of a body on the last link at q'' = 0; about the link's origin.
  Vector bias_torque(const palpate::Inertia<double>& body, const Vector& q, const Vector& dq);
  /// Joint torques of a body on the last link, at the last forward_derivatives(); base axes, about the base origin.
  Vector body_torque(const palpate::Inertia<double>& body) const;
  /// Placement of the last link, at the last forward_derivatives(); the joints' axes and origins are left out.
  palpate::Pose<double> last_pose() const;

 private:
  struct Pinocchio;
  std::unique_ptr<Pinocchio> p_;
};

}  // namespace rival
