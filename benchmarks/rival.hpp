// What the rival's files share: the arm in Pinocchio's terms.
#pragma once
#include <pinocchio/algorithm/aba-derivatives.hpp>
#include <pinocchio/algorithm/aba.hpp>
#include <pinocchio/algorithm/crba.hpp>
#include <pinocchio/algorithm/kinematics.hpp>
#include <pinocchio/algorithm/rnea-derivatives.hpp>
#include <pinocchio/algorithm/rnea.hpp>
#include <pinocchio/multibody.hpp>
#include <stdexcept>
#include <string>

#include "contest.hpp"

namespace rival {

namespace pin = pinocchio;
using contest::Numbers;
using palpate::Arm;
using palpate::JointSample;
using palpate::JointVector;

constexpr int N = 7;
using Vector = Eigen::Matrix<double, N, 1>;
using Square = Eigen::Matrix<double, N, N>;
using Factor = Eigen::LLT<Square, Eigen::Upper>;  // crba fills the upper triangle

inline Eigen::Map<const Vector> in(const JointVector& x) { return Eigen::Map<const Vector>(x.data()); }
inline Eigen::Vector3d vector3(const palpate::Vec3<double>& a) { return {a.x, a.y, a.z}; }
inline std::size_t u(int i) { return static_cast<std::size_t>(i); }

inline pin::Inertia inertia(const palpate::Inertia<double>& b) {
  const Eigen::Vector3d c = vector3(b.mc) / b.m;
  Eigen::Matrix3d I;
  I << b.I.xx, b.I.xy, b.I.xz, b.I.xy, b.I.yy, b.I.yz, b.I.xz, b.I.yz, b.I.zz;
  return {b.m, c, I - b.m * (c.squaredNorm() * Eigen::Matrix3d::Identity() - c * c.transpose())};
}

inline pin::Model model_of(const Arm& arm) {
  if (arm.n() != N) throw std::invalid_argument("the rival's matrices are made for 7 joints");
  pin::Model model;
  pin::JointIndex parent = 0;
  for (int j = 0; j < N; ++j) {
    const palpate::Body& b = arm.body(j);
    if (b.prismatic) throw std::invalid_argument("the rival is made for revolute joints");
    Eigen::Matrix3d R;
    R << vector3(b.R.cx), vector3(b.R.cy), vector3(b.R.cz);
    parent = model.addJoint(parent, pin::JointModelRZ(), pin::SE3(R, vector3(b.p)), "joint " + std::to_string(j + 1));
    model.appendBodyToJoint(parent, inertia(b.inertia));
    model.armature[j] = b.rotor_inertia;
  }
  model.gravity.linear() = vector3(arm.gravity());
  return model;
}

/// Everything a job needs of the arm.
struct Rival {
  explicit Rival(const palpate::ArmDescription& description) : arm(description), model(model_of(arm)), data(model) {}
  Arm arm;
  pin::Model model;
  pin::Data data;
};

}  // namespace rival
