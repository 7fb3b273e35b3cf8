// Joint trajectories: the quintic from rest to rest, the same from any motion, a schedule of quintics with dwell times.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>

#include "palpate/check.hpp"
#include "palpate/types.hpp"

namespace palpate {

/// q(t) = q_0 + D (10 s^3 - 15 s^4 + 6 s^5),  s = t/T,  D = q_1 - q_0: the fifth-degree polynomial with zero velocity and
/// acceleration at both ends (mass-estimation report, section 4; MATH.md section 8). All joints start and arrive together.
///
/// t [s] time since the start, T [s] duration, q_0 start and q_1 goal [rad]. Peak speed 1.875 |D|/T at T/2, peak
/// acceleration (10/sqrt 3) |D|/T^2. Before 0 it stands at q_0, from T on at q_1; goal = start is a motion of T = 0.
class Quintic {
 public:
  static constexpr double peak_speed = 1.875;                    ///< max |dq| T/|D|
  static constexpr double peak_acceleration = 5.773502691896258;  ///< max |ddq| T^2/|D|, 10/sqrt(3)

  Quintic() = default;  ///< stands at zero

  /// Motion of given duration [s]; 0 only if goal = start.
  Quintic(int n, const JointVector& start, const JointVector& goal, double duration)
      : n_(static_cast<std::size_t>(check::in_range("Quintic n", n, 1, max_joints))),
        T_(check::not_negative("Quintic duration [s]", duration)) {
    for (std::size_t j = 0; j < n_; ++j) {
      q0_[j] = check::finite(check::entry("Quintic start", j, "rad"), start[j]);
      q1_[j] = check::finite(check::entry("Quintic goal", j, "rad"), goal[j]);
      if (T_ == 0.0 && q0_[j] != q1_[j])
        check::fail("Quintic duration [s]", T_, "more than 0, because joint " + std::to_string(j) + " has to move");
    }
  }

  /// Shortest motion in which no joint exceeds its speed [rad/s] and acceleration [rad/s^2]; infinity means no limit,
  /// but a joint that moves needs one of the two.
  static Quintic within_limits(int n, const JointVector& start, const JointVector& goal, const JointVector& max_speed,
                               const JointVector& max_acceleration) {
    double T = 0.0;
    for (std::size_t j = 0; j < static_cast<std::size_t>(check::in_range("Quintic n", n, 1, max_joints)); ++j) {
      const double v = check::positive_or_infinite(check::entry("Quintic max_speed", j, "rad/s"), max_speed[j]);
      const double a = check::positive_or_infinite(check::entry("Quintic max_acceleration", j, "rad/s^2"), max_acceleration[j]);
      const double D = std::abs(goal[j] - start[j]);
      if (D > 0.0 && std::isinf(v) && std::isinf(a))
        check::fail(check::entry("Quintic max_speed", j, "rad/s"), v, "a finite limit of speed or acceleration for a joint that moves");
      T = std::max({T, peak_speed * D / v, std::sqrt(peak_acceleration * D / a)});
    }
    return {n, start, goal, T};
  }

  /// The same speed and acceleration limit for every joint.
  static Quintic within_limits(int n, const JointVector& start, const JointVector& goal, double max_speed,
                               double max_acceleration = std::numeric_limits<double>::infinity()) {
    JointVector v, a;
    v.fill(max_speed);
    a.fill(max_acceleration);
    return within_limits(n, start, goal, v, a);
  }

  [[nodiscard]] double duration() const noexcept { return T_; }  ///< [s]
  [[nodiscard]] const JointVector& start() const noexcept { return q0_; }
  [[nodiscard]] const JointVector& goal() const noexcept { return q1_; }

  /// Where to be at time t [s] since the start. NaN counts as "not started".
  [[nodiscard]] Setpoint sample(double t) const noexcept {
    Setpoint p;
    if (t >= T_) {
      p.q = q1_;
      return p;
    }
    if (!(t > 0.0)) {
      p.q = q0_;
      return p;
    }
    const double s = t / T_, r = 1.0 - s;
    const double u = std::min(s, r);  // counted from the nearer end: rounding never overshoots the goal
    const double part = u * u * u * (10.0 + u * (-15.0 + 6.0 * u));
    const double speed = 30.0 * s * s * r * r / T_;
    const double acceleration = 60.0 * s * r * (r - s) / (T_ * T_);
    for (std::size_t j = 0; j < n_; ++j) {
      const double D = q1_[j] - q0_[j];
      p.q[j] = s < r ? q0_[j] + D * part : q1_[j] - D * part;
      p.dq[j] = D * speed;
      p.ddq[j] = D * acceleration;
    }
    return p;
  }

 private:
  std::size_t n_ = 0;
  double T_ = 0.0;
  JointVector q0_{}, q1_{};
};

/// The fifth-degree polynomial from any state of motion to rest at a goal: a goal that changes while the arm moves.
///
///   q(t) = q_0 + v_0 t + a_0 t^2/2 + c_3 t^3 + c_4 t^4 + c_5 t^5,  q(T) = q_1, dq(T) = ddq(T) = 0.
///
/// q_0, v_0, a_0 [rad, rad/s, rad/s^2] where it begins, q_1 goal [rad], T duration [s]. Made within a loop: nothing is
/// thrown. A joint may swing beyond both ends if it begins fast and T is long.
class Transfer {
 public:
  Transfer() = default;  ///< stands at zero

  /// Stands at q.
  explicit Transfer(const JointVector& q) noexcept : q1_(q) {}

  /// From `start` to rest at `goal`. duration [s]; not a finite number > 0: it is at the goal at once.
  Transfer(int n, const Setpoint& start, const JointVector& goal, double duration) noexcept
      : n_(static_cast<std::size_t>(n)), T_(std::isfinite(duration) && duration > 0.0 ? duration : 0.0), start_(start), q1_(goal) {
    for (std::size_t j = 0; j < n_ && T_ > 0.0; ++j) {
      const double D = goal[j] - start.q[j], v = start.dq[j] * T_, a = start.ddq[j] * T_ * T_;
      c3_[j] = 10.0 * D - 6.0 * v - 1.5 * a;
      c4_[j] = -15.0 * D + 8.0 * v + 1.5 * a;
      c5_[j] = 6.0 * D - 3.0 * v - 0.5 * a;
    }
  }

  [[nodiscard]] double duration() const noexcept { return T_; }  ///< [s]
  [[nodiscard]] const JointVector& goal() const noexcept { return q1_; }

  /// Where to be at time t [s] since the start. NaN counts as "not started".
  [[nodiscard]] Setpoint sample(double t) const noexcept {
    Setpoint p;
    if (t >= T_) {
      p.q = q1_;
      return p;
    }
    if (!(t > 0.0)) return start_;
    const double s = t / T_;
    for (std::size_t j = 0; j < n_; ++j) {
      const double v = start_.dq[j] * T_, a = start_.ddq[j] * T_ * T_;
      p.q[j] = start_.q[j] + s * (v + s * (0.5 * a + s * (c3_[j] + s * (c4_[j] + s * c5_[j]))));
      p.dq[j] = (v + s * (a + s * (3.0 * c3_[j] + s * (4.0 * c4_[j] + s * 5.0 * c5_[j])))) / T_;
      p.ddq[j] = (a + s * (6.0 * c3_[j] + s * (12.0 * c4_[j] + s * 20.0 * c5_[j]))) / (T_ * T_);
    }
    return p;
  }

 private:
  std::size_t n_ = 0;
  double T_ = 0.0;
  Setpoint start_{};
  JointVector q1_{};
  JointVector c3_{}, c4_{}, c5_{};  // of s = t/T [rad]
};

/// Up to 32 motions one after the other, each followed by a dwell at its goal: tare and calibration motions.
///
///   Schedule s(n, q_now);  s.move_to(a, 0.5).dwell(1.0).move_to(b, 0.5).dwell(1.0);
/// Times in [s] since the start of the first motion.
class Schedule {
 public:
  static constexpr int capacity = 32;

  /// What the arm should be doing at some time.
  struct Phase {
    int index = -1;       ///< number of the motion, 0 the first; -1: the schedule is empty
    bool moving = false;  ///< else dwelling at its goal, or finished
    double elapsed = 0.0; ///< since the motion or dwell began [s]
    bool finished = false;
  };

  Schedule(int n, const JointVector& start) : n_(n), first_(n, start, start, 0.0) {}

  /// Appends a motion to goal within limits of speed [rad/s] and acceleration [rad/s^2].
  Schedule& move_to(const JointVector& goal, double max_speed, double max_acceleration = std::numeric_limits<double>::infinity()) {
    return append(Quintic::within_limits(n_, here(), goal, max_speed, max_acceleration));
  }

  /// Appends a motion to goal that takes `duration` [s].
  Schedule& move_in(const JointVector& goal, double duration) { return append(Quintic(n_, here(), goal, duration)); }

  /// Stay at the newest goal for so many seconds more.
  Schedule& dwell(double seconds) {
    check::not_negative("Schedule dwell [s]", seconds);
    if (size_ == 0) append(first_);  // a dwell before the first motion is a dwell at the start
    parts_[size_ - 1].end += seconds;
    return *this;
  }

  [[nodiscard]] int size() const noexcept { return static_cast<int>(size_); }
  [[nodiscard]] double duration() const noexcept { return size_ == 0 ? 0.0 : parts_[size_ - 1].end; }  ///< [s]

  [[nodiscard]] Setpoint sample(double t) const noexcept {
    if (size_ == 0) return first_.sample(0.0);
    const Part& p = parts_[part_at(t)];
    return p.motion.sample(t - p.begin);
  }

  [[nodiscard]] Phase phase(double t) const noexcept {
    if (size_ == 0) return {-1, false, 0.0, true};
    const std::size_t i = part_at(t);
    const double since = std::isnan(t) ? 0.0 : std::max(0.0, t - parts_[i].begin);
    const double T = parts_[i].motion.duration();
    const bool moving = since < T;
    return {static_cast<int>(i), moving, moving ? since : since - T, t >= duration()};
  }

 private:
  struct Part {
    Quintic motion{};
    double begin = 0.0, end = 0.0;  // of motion and dwell together [s]
  };

  [[nodiscard]] const JointVector& here() const noexcept { return size_ == 0 ? first_.goal() : parts_[size_ - 1].motion.goal(); }

  /// The last part that has begun; the first for t < 0 and NaN.
  [[nodiscard]] std::size_t part_at(double t) const noexcept {
    std::size_t i = 0;
    while (i + 1 < size_ && t >= parts_[i].end) ++i;
    return i;
  }

  Schedule& append(const Quintic& motion) {
    if (size_ == parts_.size()) check::fail("Schedule motions", capacity + 1, "at most " + std::to_string(capacity));
    const double begin = duration();
    parts_[size_++] = {motion, begin, begin + motion.duration()};
    return *this;
  }

  int n_;
  Quintic first_;  // stands at the start
  std::array<Part, capacity> parts_{};
  std::size_t size_ = 0;
};

}  // namespace palpate
