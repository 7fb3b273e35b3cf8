// The rigid-body recursions of a serial chain, written once for every scalar type T.
//
// All use the model  M(q) q'' + C(q,q') q' + g(q) = tau  (friction and external torque are added by the callers).
// Two forms: local sweeps (each body in its own frame, fewest operations: momentum terms, inverse dynamics, mass matrix)
// and BaseFrame (everything in base coordinates: Jacobian, regressor and exact derivatives, where bodies are combined).
// `load` is a rigid body fixed to the last link (what the arm holds), written about the last body's origin.
#pragma once
#include "palpate/arm.hpp"

namespace palpate {

namespace detail {

constexpr std::size_t at(int i) noexcept { return static_cast<std::size_t>(i); }

/// Orientation and origin of body j in body j-1 at joint position q.
template <class T>
struct Step {
  Mat3<T> R;
  Vec3<T> p;
  Step() = default;
  Step(const Body& b, const T& q) noexcept {
    if (b.prismatic) {
      R = {lift<T>(b.R.cx), lift<T>(b.R.cy), lift<T>(b.R.cz)};
      p = lift<T>(b.p) + q * R.cz;
    } else {
      T s, c;
      sincos(q, s, c);
      R = {c * b.R.cx + s * b.R.cy, c * b.R.cy - s * b.R.cx, lift<T>(b.R.cz)};
      p = lift<T>(b.p);
    }
  }
};

template <class T>
Inertia<T> body_inertia(const Arm& arm, int j, const Inertia<T>& load) noexcept {
  const Inertia<T> own = lift<T>(arm.body(j).inertia);
  return j + 1 == arm.n() ? own + load : own;
}

}  // namespace detail

/// Where every body is in the one before it, at joint positions q: for several calls at one q.
template <class T>
struct Placements {
  Placements(const Arm& arm, const Joints<T>& q) noexcept {
    int j = 0;  // an arm has a joint at least
    do steps[detail::at(j)] = detail::Step<T>(arm.body(j), q[detail::at(j)]);
    while (++j < arm.n());
  }
  std::array<detail::Step<T>, max_joints> steps;
};

/// The three terms a momentum observer needs.
template <class T>
struct MomentumTerms {
  Joints<T> p{};      ///< generalised momentum M q' [N m s]
  Joints<T> Ct_dq{};  ///< C^T q' [N m]
  Joints<T> g{};      ///< gravity torque [N m]
};

/// One sweep out and one back, without forming M or C (MATH.md section 2):
///   p_j = s_j . h_j,   (C^T q')_j = (v_{j-1} x s_j) . h_j,   g_j = s_j . (subtree gravity wrench),
/// with s_j the joint axis, v the link velocities and h_j the momentum of all bodies from j to the tip.
template <class T>
MomentumTerms<T> momentum_terms(const Arm& arm, const Joints<T>& q, const Joints<T>& dq, const Inertia<T>& load = {}) noexcept {
  struct Link {
    Mat3<T> R;
    Vec3<T> p, w_in, v_in, g, k, l;  // k, l: angular and linear momentum about the body origin
    Inertia<T> I;
  };
  std::array<Link, max_joints> links;
  const int n = arm.n();
  Vec3<T> w{}, v{}, g = lift<T>(arm.gravity());
  for (int j = 0; j < n; ++j) {
    const Body& b = arm.body(j);
    Link& L = links[detail::at(j)];
    const detail::Step<T> step(b, q[detail::at(j)]);
    L.R = step.R;
    L.p = step.p;
    L.v_in = transposed(L.R, v + cross(w, L.p));
    L.w_in = transposed(L.R, w);
    L.g = g = transposed(L.R, g);
    w = L.w_in;
    v = L.v_in;
    if (b.prismatic) v.z += dq[detail::at(j)];
    else w.z += dq[detail::at(j)];
    L.I = detail::body_inertia(arm, j, load);
    L.k = L.I.I * w + cross(L.I.mc, v);
    L.l = L.I.m * v + cross(w, L.I.mc);
  }
  MomentumTerms<T> out;
  T m{};
  Vec3<T> mc{};
  for (int j = n - 1; j >= 0; --j) {
    const Body& b = arm.body(j);
    Link& L = links[detail::at(j)];
    const auto u = detail::at(j);
    m = m + L.I.m;
    mc = mc + L.I.mc;
    if (b.prismatic) {
      out.p[u] = L.l.z;
      out.Ct_dq[u] = L.w_in.y * L.l.x - L.w_in.x * L.l.y;
      out.g[u] = -(m * L.g.z);
    } else {
      out.p[u] = L.k.z;
      out.Ct_dq[u] = (L.w_in.y * L.k.x - L.w_in.x * L.k.y) + (L.v_in.y * L.l.x - L.v_in.x * L.l.y);
      out.g[u] = -(mc.x * L.g.y - mc.y * L.g.x);
    }
    out.p[u] += b.rotor_inertia * dq[u];
    if (j > 0) {
      Link& P = links[detail::at(j - 1)];
      const Vec3<T> l = L.R * L.l;
      P.l = P.l + l;
      P.k = P.k + L.R * L.k + cross(L.p, l);
      mc = L.R * mc + m * L.p;
    }
  }
  return out;
}

/// tau = M q'' + C q' + g by Newton-Euler; with q'' = 0 the bias C q' + g.
template <class T>
Joints<T> inverse_dynamics(const Arm& arm, const Placements<T>& at, const Joints<T>& dq, const Joints<T>& ddq,
                           const Inertia<T>& load = {}) noexcept {
  struct Link {
    Vec3<T> f, t;
  };
  std::array<Link, max_joints> links;
  const int n = arm.n();
  Vec3<T> w{}, dw{}, a = -lift<T>(arm.gravity());
  for (int j = 0; j < n; ++j) {
    const Body& b = arm.body(j);
    const auto u = detail::at(j);
    Link& L = links[u];
    const detail::Step<T>& step = at.steps[u];
    a = transposed(step.R, a + cross(dw, step.p) + cross(w, cross(w, step.p)));
    w = transposed(step.R, w);
    dw = transposed(step.R, dw);
    if (b.prismatic) {
      a = a + Vec3<T>{2.0 * w.y * dq[u], -2.0 * w.x * dq[u], ddq[u]};
    } else {
      dw = dw + Vec3<T>{w.y * dq[u], -(w.x * dq[u]), ddq[u]};
      w.z += dq[u];
    }
    const Inertia<T> I = detail::body_inertia(arm, j, load);
    L.f = I.m * a + cross(dw, I.mc) + cross(w, cross(w, I.mc));
    L.t = I.I * dw + cross(w, I.I * w) + cross(I.mc, a);
  }
  Joints<T> tau{};
  for (int j = n - 1; j >= 0; --j) {
    const Body& b = arm.body(j);
    const auto u = detail::at(j);
    Link& L = links[u];
    tau[u] = (b.prismatic ? L.f.z : L.t.z) + b.rotor_inertia * ddq[u];
    if (j > 0) {
      Link& P = links[detail::at(j - 1)];
      const detail::Step<T>& step = at.steps[u];
      const Vec3<T> f = step.R * L.f;
      P.f = P.f + f;
      P.t = P.t + step.R * L.t + cross(step.p, f);
    }
  }
  return tau;
}
template <class T>
Joints<T> inverse_dynamics(const Arm& arm, const Joints<T>& q, const Joints<T>& dq, const Joints<T>& ddq, const Inertia<T>& load = {}) noexcept {
  return inverse_dynamics<T>(arm, Placements<T>(arm, q), dq, ddq, load);
}

/// g(q) [N m].
template <class T>
Joints<T> gravity_torque(const Arm& arm, const Joints<T>& q, const Inertia<T>& load = {}) noexcept {
  return momentum_terms<T>(arm, q, Joints<T>{}, load).g;
}

/// M(q) by composite bodies: column j is the momentum of the chain when only joint j moves at 1 rad/s.
template <class T>
JointMatrixT<T> mass_matrix(const Arm& arm, const Joints<T>& q, const Inertia<T>& load = {}) noexcept {
  std::array<Mat3<T>, max_joints> R;
  std::array<Vec3<T>, max_joints> p;
  JointMatrixT<T> M;
  const int n = arm.n();
  for (int j = 0; j < n; ++j) {
    const detail::Step<T> step(arm.body(j), q[detail::at(j)]);
    R[detail::at(j)] = step.R;
    p[detail::at(j)] = step.p;
  }
  Inertia<T> composite{};
  for (int j = n - 1; j >= 0; --j) {
    const Body& b = arm.body(j);
    composite = composite + detail::body_inertia(arm, j, load);
    // momentum of the composite body for unit motion of joint j
    Vec3<T> l, k;
    if (b.prismatic) {
      l = {T{}, T{}, composite.m};
      k = {composite.mc.y, -composite.mc.x, T{}};
    } else {
      l = {-composite.mc.y, composite.mc.x, T{}};
      k = {composite.I.xz, composite.I.yz, composite.I.zz};
    }
    M(j, j) = (b.prismatic ? l.z : k.z) + b.rotor_inertia;
    for (int i = j; i > 0; --i) {
      l = R[detail::at(i)] * l;
      k = R[detail::at(i)] * k + cross(p[detail::at(i)], l);
      M(i - 1, j) = M(j, i - 1) = arm.body(i - 1).prismatic ? l.z : k.z;
    }
    if (j > 0) composite = moved(R[detail::at(j)], p[detail::at(j)], composite);
  }
  return M;
}

/// Cholesky factor of a symmetric positive definite joint matrix, and solutions with it.
template <class T>
class Cholesky {
 public:
  explicit Cholesky(const JointMatrixT<T>& A, int n) noexcept : n_(n) {
    using std::sqrt;
    for (int j = 0; j < n; ++j) {
      T d = A(j, j);
      for (int k = 0; k < j; ++k) d -= L_(j, k) * L_(j, k);
      positive_ = positive_ && value(d) > 0.0;
      inv_[detail::at(j)] = T(1.0) / sqrt(d);
      for (int i = j + 1; i < n; ++i) {
        T s = A(i, j);
        for (int k = 0; k < j; ++k) s -= L_(i, k) * L_(j, k);
        L_(i, j) = s * inv_[detail::at(j)];
      }
    }
  }
  /// False if the matrix was not positive definite: solutions are then meaningless.
  bool positive() const noexcept { return positive_; }
  Joints<T> solve(Joints<T> x) const noexcept {
    for (int i = 0; i < n_; ++i) {
      for (int k = 0; k < i; ++k) x[detail::at(i)] -= L_(i, k) * x[detail::at(k)];
      x[detail::at(i)] *= inv_[detail::at(i)];
    }
    for (int i = n_ - 1; i >= 0; --i) {
      for (int k = i + 1; k < n_; ++k) x[detail::at(i)] -= L_(k, i) * x[detail::at(k)];
      x[detail::at(i)] *= inv_[detail::at(i)];
    }
    return x;
  }
  /// Solves for `columns` right-hand sides at once, rows of X in memory order (vectorises over the columns).
  void solve_rows(T* X, int stride, int columns) const noexcept {
    for (int i = 0; i < n_; ++i) {
      T* xi = X + i * stride;
      for (int k = 0; k < i; ++k) {
        const T* xk = X + k * stride;
        const T f = L_(i, k);
        for (int c = 0; c < columns; ++c) xi[c] -= f * xk[c];
      }
      for (int c = 0; c < columns; ++c) xi[c] *= inv_[detail::at(i)];
    }
    for (int i = n_ - 1; i >= 0; --i) {
      T* xi = X + i * stride;
      for (int k = i + 1; k < n_; ++k) {
        const T* xk = X + k * stride;
        const T f = L_(k, i);
        for (int c = 0; c < columns; ++c) xi[c] -= f * xk[c];
      }
      for (int c = 0; c < columns; ++c) xi[c] *= inv_[detail::at(i)];
    }
  }

 private:
  int n_;
  bool positive_ = true;
  JointMatrixT<T> L_;
  Joints<T> inv_{};
};

/// q'' = M^-1 (tau - C q' - g).
template <class T>
Joints<T> forward_dynamics(const Arm& arm, const Joints<T>& q, const Joints<T>& dq, const Joints<T>& tau, const Inertia<T>& load = {}) noexcept {
  Joints<T> r = inverse_dynamics<T>(arm, q, dq, Joints<T>{}, load);
  for (int j = 0; j < arm.n(); ++j) r[detail::at(j)] = tau[detail::at(j)] - r[detail::at(j)];
  return Cholesky<T>(mass_matrix<T>(arm, q, load), arm.n()).solve(r);
}

/// Placement of the last body in the base frame, with origins and axes of all joints.
template <class T>
struct Pose {
  Joints<Vec3<T>> origin, axis;  ///< of joint j, base frame
  Mat3<T> R;                         ///< last body's axes in the base frame
  Vec3<T> p;                         ///< last body's origin [m]
};
template <class T>
Pose<T> forward_kinematics(const Arm& arm, const Joints<T>& q) noexcept {
  Pose<T> P{};
  P.R = {lift<T>(identity3.cx), lift<T>(identity3.cy), lift<T>(identity3.cz)};
  for (int j = 0; j < arm.n(); ++j) {
    const detail::Step<T> step(arm.body(j), q[detail::at(j)]);
    P.p = P.p + P.R * step.p;
    P.R = P.R * step.R;
    P.origin[detail::at(j)] = P.p;
    P.axis[detail::at(j)] = P.R.cz;
  }
  return P;
}

/// Column j of the translational Jacobian of a point x (base frame) carried by the last link: velocity of x per q'_j.
template <class T>
Vec3<T> jacobian_column(const Arm& arm, const Pose<T>& P, int j, const Vec3<T>& x) noexcept {
  const auto u = detail::at(j);
  return arm.body(j).prismatic ? P.axis[u] : cross(P.axis[u], x - P.origin[u]);
}

/// The chain in base coordinates at (q, q', q''): spatial axes, velocities, momenta; torque and its exact derivatives.
///
/// With motion vectors (w; v) at the base origin, s_j the joint axis, v_j and a_j (gravity included) of link j,
/// s'_j = v_{j-1} x s_j, s''_j = a_{j-1} x s_j + v_{j-1} x s'_j, I_j and f_j composite (bodies j..n):
///   dtau_i/dq_j  = s_i . (2 B_k s'_j + I_k s''_j [+ s_j x* f_j if i <= j]),  k = max(i, j)
///   dtau_i/dq'_j = 2 s_i . (B_k s_j + I_k s'_j),   M_ij = s_i . I_k s_j
/// B m is the wrench of the force density w_m x u (u the velocity field of the body), so it sees only the angular part of m.
/// (Equivalent to Singh, Russell, Wensing, "Efficient analytical derivatives of rigid-body dynamics", RA-L 2022.)
class BaseFrame {
 public:
  BaseFrame(const Arm& arm, const JointVector& q, const JointVector& dq, const Inertia<double>& load = {}) noexcept
      : arm_(arm), dq_(dq) {
    using V = Vec3<double>;
    pose_.R = identity3;
    V w{}, v{};
    for (int j = 0; j < arm.n(); ++j) {
      Link& L = links_[detail::at(j)];
      const Body& b = arm.body(j);
      const detail::Step<double> step(b, q[detail::at(j)]);
      pose_.p = pose_.p + pose_.R * step.p;
      pose_.R = pose_.R * step.R;
      pose_.origin[detail::at(j)] = pose_.p;
      pose_.axis[detail::at(j)] = pose_.R.cz;
      if (b.prismatic) L.s = {V{}, pose_.R.cz};
      else L.s = {pose_.R.cz, cross(pose_.p, pose_.R.cz)};
      L.ds = cross_motion({w, v}, L.s);
      w = w + dq[detail::at(j)] * L.s.w;
      v = v + dq[detail::at(j)] * L.s.v;
      L.v = {w, v};
      L.I = moved(pose_.R, pose_.p, detail::body_inertia(arm, j, load));
    }
  }

  const Pose<double>& pose() const noexcept { return pose_; }
  /// Body j (the last one with its load) about the base origin, base axes.
  const Inertia<double>& body(int j) const noexcept { return links_[detail::at(j)].I; }

  /// tau = M q'' + C q' + g; also fills what derivatives() and the regressors need.
  JointVector inverse_dynamics(const JointVector& ddq) noexcept {
    Motion a{{}, -arm_.gravity()};
    const int n = arm_.n();
    for (int j = 0; j < n; ++j) {
      Link& L = links_[detail::at(j)];
      const auto u = detail::at(j);
      L.dds = cross_motion(a, L.s) + cross_motion(j > 0 ? links_[u - 1].v : Motion{}, L.ds);
      a = a + ddq[u] * L.s + dq_[u] * L.ds;
      L.a = a;
      L.f = wrench(L.I, L.a, L.v);
    }
    JointVector tau{};
    Wrench6 f{};
    for (int j = n - 1; j >= 0; --j) {
      Link& L = links_[detail::at(j)];
      L.f = f = f + L.f;
      tau[detail::at(j)] = dot6(L.s, f) + arm_.body(j).rotor_inertia * ddq[detail::at(j)];
    }
    return tau;
  }

  /// M, dtau/dq and dtau/dq' at the state of the last inverse_dynamics() call.
  void derivatives(JointMatrix& M, JointMatrix& dtau_dq, JointMatrix& dtau_ddq_velocity) const noexcept {
    using V = Vec3<double>;
    const int n = arm_.n();
    Inertia<double> I{};
    V P{};                 // linear momentum of the composite
    Mat3<double> U{};      // integral of u x^T dm of the composite
    for (int j = n - 1; j >= 0; --j) {
      const Link& L = links_[detail::at(j)];
      I = I + L.I;
      P = P + (L.I.m * L.v.v + cross(L.v.w, L.I.mc));
      add_field_moment(L, U);
      const Wrench6 H = momentum(I, L.s);
      const Wrench6 A = 2.0 * coriolis(P, U, L.ds.w) + momentum(I, L.dds) + cross_force(L.s, L.f);
      const Wrench6 D = 2.0 * (coriolis(P, U, L.s.w) + momentum(I, L.ds));
      const V b = 2.0 * coriolis_transposed(P, U, L.s);
      for (int i = 0; i <= j; ++i) {
        const Motion& s = links_[detail::at(i)].s;
        M(i, j) = M(j, i) = dot6(s, H);
        dtau_dq(i, j) = dot6(s, A);
        dtau_ddq_velocity(i, j) = dot6(s, D);
        if (i < j) {
          const Link& Li = links_[detail::at(i)];
          dtau_dq(j, i) = dot(b, Li.ds.w) + dot6(Li.dds, H);
          dtau_ddq_velocity(j, i) = dot(b, Li.s.w) + 2.0 * dot6(Li.ds, H);
        }
      }
      M(j, j) += arm_.body(j).rotor_inertia;
    }
  }

  /// Torque per unit of a body fixed to link `link` and written in base coordinates, at the last q'':
  /// one column of the regressor (tau_i = 0 beyond the link).
  JointVector body_torque(int link, const Inertia<double>& body) const noexcept {
    const Link& L = links_[detail::at(link)];
    const Wrench6 f = wrench(body, L.a, L.v);
    JointVector tau{};
    for (int i = 0; i <= link; ++i) tau[detail::at(i)] = dot6(links_[detail::at(i)].s, f);
    return tau;
  }

  /// Angular velocity and spatial quantities of a link, base frame.
  struct Motion {
    Vec3<double> w, v;
    friend Motion operator+(const Motion& a, const Motion& b) noexcept { return {a.w + b.w, a.v + b.v}; }
    friend Motion operator*(double s, const Motion& a) noexcept { return {s * a.w, s * a.v}; }
  };

 private:
  struct Wrench6 {
    Vec3<double> t, f;  // moment about the base origin, force
    friend Wrench6 operator+(const Wrench6& a, const Wrench6& b) noexcept { return {a.t + b.t, a.f + b.f}; }
    friend Wrench6 operator*(double s, const Wrench6& a) noexcept { return {s * a.t, s * a.f}; }
  };
  struct Link {
    Motion s, ds, dds, v, a;
    Inertia<double> I;
    Wrench6 f;  // of this body, then of the composite
  };
  static double dot6(const Motion& m, const Wrench6& f) noexcept { return dot(m.w, f.t) + dot(m.v, f.f); }
  static Motion cross_motion(const Motion& a, const Motion& b) noexcept {
    return {cross(a.w, b.w), cross(a.v, b.w) + cross(a.w, b.v)};
  }
  static Wrench6 cross_force(const Motion& m, const Wrench6& f) noexcept {
    return {cross(m.w, f.t) + cross(m.v, f.f), cross(m.w, f.f)};
  }
  static Wrench6 momentum(const Inertia<double>& I, const Motion& m) noexcept {
    return {I.I * m.w + cross(I.mc, m.v), I.m * m.v + cross(m.w, I.mc)};
  }
  static Wrench6 wrench(const Inertia<double>& I, const Motion& a, const Motion& v) noexcept {
    return momentum(I, a) + cross_force(v, momentum(I, v));
  }
  /// U = integral u x^T dm = v mc^T + [w] S, S = tr(I)/2 1 - I the second moment about the origin.
  static void add_field_moment(const Link& L, Mat3<double>& U) noexcept {
    const Sym3<double>& I = L.I.I;
    const double h = 0.5 * (I.xx + I.yy + I.zz);
    const Vec3<double> Sx{h - I.xx, -I.xy, -I.xz}, Sy{-I.xy, h - I.yy, -I.yz}, Sz{-I.xz, -I.yz, h - I.zz};
    U.cx = U.cx + L.I.mc.x * L.v.v + cross(L.v.w, Sx);
    U.cy = U.cy + L.I.mc.y * L.v.v + cross(L.v.w, Sy);
    U.cz = U.cz + L.I.mc.z * L.v.v + cross(L.v.w, Sz);
  }
  /// B m: moment (tr(U) 1 - U) w, force w x P.
  static Wrench6 coriolis(const Vec3<double>& P, const Mat3<double>& U, const Vec3<double>& w) noexcept {
    const double trace = U.cx.x + U.cy.y + U.cz.z;
    return {trace * w - U * w, cross(w, P)};
  }
  /// Angular part of B^T s: its linear part is zero.
  static Vec3<double> coriolis_transposed(const Vec3<double>& P, const Mat3<double>& U, const Motion& s) noexcept {
    const double trace = U.cx.x + U.cy.y + U.cz.z;
    return trace * s.w - transposed(U, s.w) + cross(P, s.v);
  }

  const Arm& arm_;
  JointVector dq_;
  Pose<double> pose_{};
  std::array<Link, max_joints> links_;
};

/// Regressor Y(q,q',q'') of the rigid-body parameters: tau = Y pi, ten columns per link in link axes about the joint frame:
/// m, m c_x, m c_y, m c_z, I_xx, I_xy, I_xz, I_yy, I_yz, I_zz. `Y` is row-major n x (10 n). Rotor inertia adds I_a q''.
inline void regressor(const Arm& arm, const JointVector& q, const JointVector& dq, const JointVector& ddq, double* Y) noexcept {
  const int n = arm.n(), columns = 10 * n;
  BaseFrame chain(arm, q, dq);
  chain.inverse_dynamics(ddq);
  Mat3<double> R = identity3;
  Vec3<double> p{};
  for (int j = 0; j < n; ++j) {
    const detail::Step<double> step(arm.body(j), q[detail::at(j)]);
    p = p + R * step.p;
    R = R * step.R;
    const Mat3<double> R_link = R * arm.body(j).R_body_link;
    for (int c = 0; c < 10; ++c) {
      Inertia<double> unit{};
      std::array<double*, 10> entry{&unit.m,    &unit.mc.x, &unit.mc.y, &unit.mc.z, &unit.I.xx,
                                    &unit.I.xy, &unit.I.xz, &unit.I.yy, &unit.I.yz, &unit.I.zz};
      *entry[detail::at(c)] = 1.0;
      const JointVector column = chain.body_torque(j, moved(R_link, p, unit));
      for (int i = 0; i < n; ++i) Y[i * columns + 10 * j + c] = column[detail::at(i)];
    }
  }
}

}  // namespace palpate
