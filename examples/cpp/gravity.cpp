// What must the motors of a two-link arm hold, and how much more with 0.25 kg at the tip?
#include <cstdio>
#include <palpate/arm.hpp>
#include <palpate/chain.hpp>

int main() {
  palpate::ArmDescription description;
  description.n = 2;
  for (std::size_t j = 0; j < 2; ++j) {
    palpate::JointDescription& joint = description.joints[j];
    joint.axis = {0, 1, 0};                           // turns about y; the base frame is z-up
    joint.T_parent_joint.p = {j == 0 ? 0.0 : 0.3, 0, 0};  // [m] links 0.3 m long
    joint.mass = 1.0;                                 // [kg]
    joint.com = {0.15, 0, 0};                         // [m] in the link frame
    joint.inertia = {1e-4, 0, 0, 7.5e-3, 0, 7.5e-3};  // [kg m^2] xx xy xz yy yz zz about the centre of mass
  }
  const palpate::Arm arm(description);  // checks every figure; throws std::invalid_argument naming the joint

  palpate::Inertia<double> load{};  // what the tip holds, a point mass in the last link's body axes
  load.m = 0.25;
  load.mc = load.m * (arm.body(1).R_body_link * palpate::Vec3<double>{0.3, 0, 0});

  const palpate::JointVector q{}, at_rest{};  // stretched out along x
  const palpate::JointVector empty = palpate::momentum_terms(arm, q, at_rest).g;
  const palpate::JointVector holding = palpate::momentum_terms(arm, q, at_rest, load).g;
  for (std::size_t j = 0; j < 2; ++j) {
    std::printf("joint %zu: %+.3f N m empty, %+.3f N m with 0.25 kg at the tip\n", j + 1, empty[j], holding[j]);
  }
}
