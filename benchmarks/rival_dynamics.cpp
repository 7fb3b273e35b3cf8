// The rival's dynamics on Pinocchio's headers: the only file that compiles them.
//
// Written to be as fast as Pinocchio's interface allows. Its joint types are a template parameter of its Model: with revolute-z
// as the only one (every joint's frame is turned so) no call is dispatched, everything is inlined, and a compiler needs half a
// minute and 1.5 GB instead of many minutes and 4.6 GB. crba runs in the LOCAL, aba in the WORLD convention, each its faster one.
// Tried with Pinocchio's own joint types and not faster: the compiled library libpinocchio, -march=native (within 5 %).

// Model and Data ask a joint whether it is a mimic; by default that is an error where none can be.
#define BOOST_VARIANT_USE_RELAXED_GET_BY_DEFAULT
#include <pinocchio/algorithm/aba-derivatives.hpp>
#include <pinocchio/algorithm/aba.hpp>
#include <pinocchio/algorithm/crba.hpp>
#include <pinocchio/algorithm/kinematics.hpp>
#include <pinocchio/algorithm/rnea.hpp>
#include <pinocchio/multibody.hpp>
#include <stdexcept>
#include <string>

#include "rival.hpp"

namespace rival {

namespace {

namespace pin = pinocchio;

template <class Scalar_, int Options_>
struct OnlyRevoluteZ {
  using Scalar = Scalar_;
  static constexpr int Options = Options_;
  using JointModelVariant = boost::variant<pin::JointModelRevoluteTpl<Scalar, Options, 2>>;
  using JointDataVariant = boost::variant<pin::JointDataRevoluteTpl<Scalar, Options, 2>>;
};

using Model = pin::ModelTpl<double, 0, OnlyRevoluteZ>;
using Data = pin::DataTpl<double, 0, OnlyRevoluteZ>;

Eigen::Matrix3d matrix3(const palpate::Sym3<double>& A) {
  Eigen::Matrix3d M;
  M << A.xx, A.xy, A.xz, A.xy, A.yy, A.yz, A.xz, A.yz, A.zz;
  return M;
}

pin::Inertia inertia(const palpate::Inertia<double>& b) {
  const Eigen::Vector3d c = vector3(b.mc) / b.m;
  return {b.m, c, matrix3(b.I) - b.m * (c.squaredNorm() * Eigen::Matrix3d::Identity() - c * c.transpose())};
}
Model model_of(const palpate::Arm& arm) {
  if (arm.n() != N) throw std::invalid_argument("the rival's matrices are made for 7 joints");
  Model model;
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
/// Of a body that need not be physical, as pin::Inertia must.
pin::Force wrench(const palpate::Inertia<double>& b, const pin::Motion& a, const pin::Motion& v) {
  const Eigen::Vector3d mc = vector3(b.mc);
  const Eigen::Matrix3d I = matrix3(b.I);
  const auto momentum = [&](const pin::Motion& m) {
    return pin::Force(b.m * m.linear() + m.angular().cross(mc), I * m.angular() + mc.cross(m.linear()));
  };
  return momentum(a) + v.cross(momentum(v));
}

}  // namespace

struct Dynamics::Pinocchio {
  explicit Pinocchio(const palpate::Arm& arm) : model(model_of(arm)), data(model), own(model.inertias[N]), rotors(model.armature) {}
  Eigen::Map<const Square> coriolis(const Vector& q, const Vector& dq) {
    pin::computeCoriolisMatrix(model, data, q, dq);
    return Eigen::Map<const Square>(data.C.data());
  }
  Model model;
  Data data;
  pin::Inertia own;  // of the bare last link
  Vector rotors;
};

Dynamics::Dynamics(const palpate::Arm& arm) : p_(std::make_unique<Pinocchio>(arm)) {}
Dynamics::~Dynamics() = default;

Vector Dynamics::inverse(const Vector& q, const Vector& dq, const Vector& ddq) { return pin::rnea(p_->model, p_->data, q, dq, ddq); }
Vector Dynamics::bias(const Vector& q, const Vector& dq) { return pin::nonLinearEffects(p_->model, p_->data, q, dq); }
Vector Dynamics::forward(const Vector& q, const Vector& dq, const Vector& tau) {
  return pin::aba(p_->model, p_->data, q, dq, tau, pin::Convention::WORLD);
}
Square Dynamics::mass_matrix(const Vector& q) { return pin::crba(p_->model, p_->data, q, pin::Convention::LOCAL); }

void Dynamics::momentum_terms(const Vector& q, const Vector& dq, Vector& p, Vector& Ct_dq, Vector& g) {
  g = pin::computeGeneralizedGravity(p_->model, p_->data, q);
  p = pin::rnea(p_->model, p_->data, q, Vector::Zero(), dq) - g;
  Ct_dq.noalias() = p_->coriolis(q, dq).transpose() * dq;
}
void Dynamics::momentum_terms_from_coriolis(const Vector& q, const Vector& dq, Vector& p, Vector& Ct_dq, Vector& g) {
  Ct_dq.noalias() = p_->coriolis(q, dq).transpose() * dq;
  using Columns = Eigen::Matrix<double, 6, N>;
  const Eigen::Map<const Columns> J(p_->data.J.data()), H(p_->data.Ag.data());
  g.noalias() = -(H.topRows<3>().transpose() * p_->model.gravity.linear());
  const Square M = J.transpose() * H;
  p.noalias() = M.selfadjointView<Eigen::Upper>() * dq;
  p += p_->rotors.cwiseProduct(dq);
}

Vector Dynamics::forward_derivatives(const Vector& q, const Vector& dq, const Vector& tau, const Vector& armature, Square& by_q,
                                     Square& by_dq, Square& inverse_inertia) {
  p_->model.armature = p_->rotors + armature;
  pin::computeABADerivatives(p_->model, p_->data, q, dq, tau, by_q, by_dq, inverse_inertia);
  p_->model.armature = p_->rotors;
  return p_->data.ddq;
}
void Dynamics::carry(const palpate::Inertia<double>& load) {
  p_->model.inertias[N] = p_->own;
  if (load.m != 0.0) p_->model.inertias[N] += inertia(load);
}
Vector Dynamics::bias_torque(const palpate::Inertia<double>& body, const Vector& q, const Vector& dq) {
  const Data& data = p_->data;
  pin::forwardKinematics(p_->model, p_->data, q, dq, Vector::Zero());
  pin::Force f = wrench(body, data.a[N] - data.oMi[N].actInv(p_->model.gravity), data.v[N]);
  Vector tau;
  for (pin::JointIndex i = N; i > 0; --i) {
    tau[static_cast<Eigen::Index>(i) - 1] = f.angular().z();
    f = data.liMi[i].act(f);
  }
  return tau;
}
Vector Dynamics::body_torque(const palpate::Inertia<double>& body) const {
  return p_->data.J.transpose() * wrench(body, p_->data.oa_gf[N], p_->data.ov[N]).toVector();
}
palpate::Pose<double> Dynamics::last_pose() const {
  const Eigen::Matrix3d R = p_->data.oMi[N].rotation();
  const Eigen::Vector3d p = p_->data.oMi[N].translation();
  palpate::Pose<double> pose{};
  pose.R = {{R(0, 0), R(1, 0), R(2, 0)}, {R(0, 1), R(1, 1), R(2, 1)}, {R(0, 2), R(1, 2), R(2, 2)}};
  pose.p = {p.x(), p.y(), p.z()};
  return pose;
}

}  // namespace rival
