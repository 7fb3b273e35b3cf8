// SenderClock: when a position was measured, if its sender gives no time stamp and runs at another pace than the reader.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <numbers>

#include "palpate/check.hpp"
#include "palpate/filter.hpp"
#include "palpate/types.hpp"

namespace palpate {

struct SenderClockConfig {
  double period = 0.0;         ///< of the sender [s], more than twice stamp_std; 0: found from the data
  double stamp_std = 5e-4;     ///< jitter of the reader's time stamps [s], > 0
  double position_std = 2e-5;  ///< of a position [rad], > 0
  double acceleration = 0.1;   ///< the least that the speed is thought to change [rad/s^2], > 0; how much it does is learnt
  double max_speed = 10.0;     ///< no joint is faster [rad/s]; a position that is further away ends what came before
};

/// When the newest position was measured.
struct SenderStamp {
  std::int64_t time_ns = 0;   ///< of the measurement by the sender's clock, placed on the reader's time line [ns]; the read stamp until locked
  int cycles = 0;             ///< sender cycles since the measurement before; 0 until locked
  double interval = 0.0;      ///< since the measurement before [s]: cycles T, by the read stamps until locked; 0: nothing to compare with
  bool fresh = false;         ///< this is a new measurement; false: the one before was read again, or none has come yet
  Status status = Status::warming;  ///< ok: locked to the sender; gap: started anew, difference nothing across it
};

/// A sender with period T overwrites a variable; a reader looks at t_i, at its own pace h. Between two looks there are
/// m_i = k_i - k_{i-1} new cycles, k_i = floor(c(t_i)), c' = 1/T: for T = 5 ms and h = 8.1 ms now one, now two. Who divides by h
/// each time makes noise of the speed itself (ratio 0.61 : 1.23): the "encoder noise" of the whiteboard project (W; MATH.md section 8).
///
/// Two witnesses tell m_i. The clock: c(t) is a straight line, estimated as Gaussian (c, c') and cut to [k_i, k_i + 1) after each
/// look (moments of the truncated normal), so it learns only where the line runs close to a whole number. The motion: x_i = q_i -
/// q_{i-1} is m_i times the step per cycle seen last, within an acceleration. The most probable m_i of both is taken.
///   t_k <- t_k + m_i T  is the time of measurement, drawn slowly to the line; (q_i - q_{i-1})/(m_i T) has the delay of a plain
/// difference and none of its noise.
///
/// Without a given period it is found in the first stretch of motion: the steps fall into two groups n and n + 1 (n = 0: some
/// positions are read twice); n and the assignment are those with the smoothest speed (Viterbi), T follows from counting cycles. If
/// the steps are smooth as they come there is nothing to mend: the read stamps are the stamps.
class SenderClock {
 public:
  static constexpr int window = 48;  ///< looks in motion from which the period is found
  static constexpr int most = 8;     ///< most sender cycles per look that are told apart while searching

  explicit SenderClock(int n, const SenderClockConfig& config = {})
      : n_(static_cast<std::size_t>(check::in_range("SenderClock n", n, 1, max_joints))), c_(config) {
    check::not_negative("SenderClockConfig period [s]", config.period);
    check::positive("SenderClockConfig stamp_std [s]", config.stamp_std);
    if (config.period > 0.0 && config.period <= 2.0 * config.stamp_std)
      check::fail("SenderClockConfig period [s]", config.period, "more than twice stamp_std, or the stamps tell no cycles apart");
    check::positive("SenderClockConfig position_std [rad]", config.position_std);
    check::positive("SenderClockConfig acceleration [rad/s^2]", config.acceleration);
    check::positive("SenderClockConfig max_speed [rad/s]", config.max_speed);
  }

  /// time_ns: when the position q [rad] was read.
  SenderStamp step(std::int64_t time_ns, const JointVector& q) noexcept {
    out_.cycles = 0;
    out_.interval = 0.0;
    out_.fresh = false;
    if (!check::all_finite(q, n_)) return refused(Status::non_finite);
    if (mode_ != Mode::empty && time_ns <= read_ns_) return refused(Status::time_error);
    const double dt = mode_ == Mode::empty ? 0.0 : seconds_between(read_ns_, time_ns);
    JointVector x{};
    double moved = 0.0;
    bool jump = false;
    for (std::size_t j = 0; j < n_; ++j) {
      x[j] = q[j] - q_[j];
      moved += std::abs(x[j]);
      jump = jump || !(std::abs(x[j]) <= 2.0 * c_.max_speed * dt);
    }
    read_ns_ = time_ns;
    q_ = q;
    out_.time_ns = time_ns;
    if (mode_ == Mode::empty) {
      mode_ = Mode::silent;  // one position tells not whether anybody sends
      out_.status = Status::warming;
      return out_;
    }
    if (mode_ == Mode::silent && moved == 0.0) return out_;  // memory that nobody has written to yet looks like this
    if (jump || dt > longest_pause) return begin();
    out_.status = Status::warming;
    if (mode_ == Mode::silent) mode_ = Mode::searching;
    if (mode_ == Mode::searching) {
      search(dt, moved, x);
    } else if (mode_ == Mode::locked) {
      follow(dt, x);
      return out_;
    }
    out_.fresh = true;
    out_.interval = dt;
    if (mode_ == Mode::plain) out_.status = Status::ok;
    return out_;
  }

  /// T [s]; 0 until locked, and where the read stamps are the stamps.
  [[nodiscard]] double period() const noexcept { return mode_ == Mode::locked ? 1.0 / rate_ : 0.0; }
  [[nodiscard]] const SenderStamp& value() const noexcept { return out_; }
  void reset() noexcept { *this = SenderClock(*this, Again{}); }

 private:
  struct Again {};
  SenderClock(const SenderClock& other, Again) noexcept : n_(other.n_), c_(other.c_) {}

  enum class Mode : std::uint8_t {
    empty,      // nothing read
    silent,     // nothing has changed since the first position
    searching,  // for the sender's period
    locked,     // to it
    plain,      // nothing to mend
  };
  struct Look {
    double dt, moved;  // [s], sum of |x_j| [rad]
    JointVector x;
  };
  static constexpr double longest_pause = 0.25;  // after a longer one nothing before is used [s]
  static constexpr double phase_walk = 2e-3;     // of the sender against the reader's clock [cycles per look]
  static constexpr double stamp_outliers = 1e-4; // share of stamps that may be off by any amount: a stalled thread
  static constexpr double rate_walk = 1e-5;      // of c', relative [1/sqrt(s)]

  SenderStamp refused(Status why) noexcept {
    out_.status = why;
    return out_;
  }

  /// This position is the first of a new story.
  SenderStamp begin() noexcept {
    mode_ = Mode::searching;
    looks_ = 0;
    out_.fresh = true;
    out_.status = Status::gap;
    return out_;
  }

  void search(double dt, double moved, const JointVector& x) noexcept {
    if (looks_ > 0 && dt > 1.5 * ring_[0].dt) looks_ = 0;  // an interruption: cycles cannot be counted across it
    if (looks_ == window) {
      std::copy(ring_.begin() + 1, ring_.end(), ring_.begin());
      --looks_;
    }
    ring_[looks_++] = {dt, moved, x};
    if (looks_ < window) return;
    double total = 0.0, length = 0.0;
    int repeats = 0, moving = 0;
    for (const Look& l : ring_) {
      total += l.moved;
      length += l.dt;
      repeats += l.moved == 0.0;
    }
    const double mean = total / window;
    for (const Look& l : ring_) moving += l.moved > 0.3 * mean;
    if (mean < 10.0 * c_.position_std) return;  // at rest

    std::array<std::uint8_t, window> m{};
    if (c_.period > 0.0) {
      const double ratio = length / window / c_.period;
      if (ratio >= 200.0) return;
      assign(static_cast<int>(ratio), m);
    } else if (repeats > window / 20 && repeats + moving > window - 2) {  // the reader is the faster one
      assign(0, m);
    } else if (moving == window) {
      const double plain = smoothness(0, nullptr);
      int best = 0;
      double least = plain;
      for (int n = 1; n < most; ++n) {
        const double cost = smoothness(n, nullptr);
        if (cost < least) {
          least = cost;
          best = n;
        }
      }
      if (plain < 4.0 * least) {
        if (plain < 1e-3) mode_ = Mode::plain;
        return;
      }
      (void)smoothness(best, &m);
    } else {
      return;
    }
    lock(m);
  }

  /// The assignment for groups n and n + 1.
  void assign(int n, std::array<std::uint8_t, window>& m) const noexcept {
    if (n > 0) (void)smoothness(n, &m);
    else
      for (std::size_t i = 0; i < window; ++i) m[i] = ring_[i].moved > 0.0 ? 1 : 0;
  }

  /// Mean square change of the step per cycle between looks, relative, for the best assignment to n or n + 1 cycles; n = 0: one each.
  double smoothness(int n, std::array<std::uint8_t, window>* assignment) const noexcept {
    // at most 0.25: one outlier must not decide
    const auto change = [](double a, double b) { return std::min(0.25, 4.0 * (a - b) * (a - b) / ((a + b) * (a + b))); };
    if (n == 0) {
      double sum = 0.0;
      for (std::size_t i = 1; i < window; ++i) sum += change(ring_[i].moved, ring_[i - 1].moved);
      return sum / (window - 1);
    }
    std::array<std::array<std::uint8_t, 2>, window> from{};
    std::array<double, 2> cost{};
    for (std::size_t i = 1; i < window; ++i) {
      std::array<double, 2> next{};
      for (std::size_t b = 0; b < 2; ++b) {
        const double w = ring_[i].moved / (n + static_cast<double>(b));
        const double c0 = cost[0] + change(w, ring_[i - 1].moved / n), c1 = cost[1] + change(w, ring_[i - 1].moved / (n + 1));
        from[i][b] = c1 < c0;
        next[b] = std::min(c0, c1);
      }
      cost = next;
    }
    std::size_t b = cost[1] < cost[0];
    const double least = cost[b] / (window - 1);
    if (assignment != nullptr)
      for (std::size_t i = window; i-- > 0; b = from[i][b]) (*assignment)[i] = static_cast<std::uint8_t>(n + static_cast<int>(b));
    return least;
  }

  /// Straight line through (t_i, k_i + 1/2): c, c' and their covariance, 1/12 the variance of a fraction that may be anything.
  void lock(const std::array<std::uint8_t, window>& m) noexcept {
    double t = 0.0, k = 0.0, st = 0.0, sk = 0.0;
    std::array<double, window> T{}, K{};
    for (std::size_t i = 0; i < window; ++i) {
      T[i] = t += ring_[i].dt;
      K[i] = k += m[i];
      st += t;
      sk += k;
    }
    st /= window;
    sk /= window;
    double tt = 0.0, tk = 0.0;
    for (std::size_t i = 0; i < window; ++i) {
      tt += (T[i] - st) * (T[i] - st);
      tk += (T[i] - st) * (K[i] - sk);
    }
    const double rate = tk / tt;
    double scatter = 0.0;
    for (std::size_t i = 0; i < window; ++i) scatter += (K[i] - sk - rate * (T[i] - st)) * (K[i] - sk - rate * (T[i] - st));
    if (!(rate > 0.0) || scatter > 0.25 * window || 2.0 * c_.stamp_std * rate >= 1.0) return;  // no clock, or none that the stamps show
    const double age = T[window - 1] - st;
    rate_ = c_.period > 0.0 ? 1.0 / c_.period : rate;
    phase_ = std::clamp(sk + 0.5 + rate_ * age - K[window - 1], 0.0, 1.0);
    const double v = 1.0 / 12.0;
    P_ = {v * (1.0 / window + age * age / tt), v * age / tt, v / tt};
    if (c_.period > 0.0) P_ = {v, 0.0, 1e-8 * rate_ * rate_};
    last_cycles_ = 0;
    for (std::size_t i = 0; i < window; ++i)
      if (m[i] > 0) learn(ring_[i].x, m[i]);
    time_ns_ = read_ns_ - std::llround(phase_ / rate_ * 1e9);
    doubts_ = 0.0;
    mode_ = Mode::locked;
  }

  void follow(double dt, const JointVector& x) noexcept {
    // predict c at this look, counted from the sample that was read at the last one
    double c = phase_ + rate_ * dt;
    auto [p00, p01, p11] = P_;
    p00 += 2.0 * dt * p01 + dt * dt * p11 + phase_walk * phase_walk;
    p01 += dt * p11;
    p11 += rate_walk * rate_walk * rate_ * rate_ * dt;
    const double jitter = c_.stamp_std * rate_;
    double spread = std::sqrt(p00 + jitter * jitter);
    if (spread > 0.5) {  // after a rest: where in the cycle is no longer known, its length is
      p00 = 1.0 / 12.0;
      p01 = 0.0;
      spread = std::sqrt(p00 + jitter * jitter);
    }

    const int nearest = static_cast<int>(std::floor(c)), reach = 1 + static_cast<int>(4.0 * spread);
    int m = 0;
    double best = -std::numeric_limits<double>::infinity(), clock = 0.0;
    for (int i = std::max(0, nearest - reach); i <= std::max(0, nearest + reach); ++i) {
      const double p = share((i - c) / spread, (i + 1 - c) / spread);
      const double score = std::log(p + stamp_outliers) + motion(x, i);
      if (score > best) {
        best = score;
        m = i;
        clock = p;
      }
    }
    // motion against the clock time and again: the lock is wrong
    doubts_ = 0.95 * doubts_ + (clock < 1e-3 ? 1.0 : 0.0);
    if (doubts_ > 5.0) {
      begin();
      return;
    }

    // cut c + jitter to [m, m + 1)
    const double a = (m - c) / spread, b = (m + 1 - c) / spread;
    const double mass = share(a, b);
    double mean, left;  // of the cut standard normal: mean, variance
    if (mass > 1e-9) {
      const double root = std::sqrt(2.0 * std::numbers::pi);
      const double fa = std::exp(-0.5 * a * a) / root, fb = std::exp(-0.5 * b * b) / root;
      mean = (fa - fb) / mass;
      left = std::max(1e-3, 1.0 + (a * fa - b * fb) / mass - mean * mean);
    } else {
      mean = a > 0.0 ? a : b;
      left = 0.1;
    }
    const double s = spread * spread, k0 = p00 / s, k1 = p01 / s, innovation = mean * spread, shrink = s * (1.0 - left);
    c += k0 * innovation;
    rate_ += k1 * innovation;
    P_ = {p00 - k0 * k0 * shrink, p01 - k0 * k1 * shrink, p11 - k1 * k1 * shrink};
    phase_ = std::clamp(c - m, -0.5, 1.5);
    rate_ = std::max(rate_, 1e-3);

    out_.cycles = m;
    out_.fresh = m > 0;
    out_.status = Status::ok;
    if (m > 0) {
      const double period_ns = 1e9 / rate_;
      const double line = static_cast<double>(read_ns_ - time_ns_) - phase_ * period_ns;  // where the line puts the sample
      const double whole = m * period_ns;
      out_.interval = whole * 1e-9;
      time_ns_ += std::llround(whole + std::clamp(0.01 * (line - whole), -0.002 * period_ns, 0.002 * period_ns));
      learn(x, m);
    }
    out_.time_ns = time_ns_;
  }

  /// The step per cycle, and how much it changes from one cycle to the next: mean square of the joint that changes most, forgetting.
  void learn(const JointVector& x, int m) noexcept {
    double most_changed = 0.0;
    for (std::size_t j = 0; j < n_; ++j) {
      const double w = x[j] / m, change = last_cycles_ > 0 ? (w - per_cycle_[j]) / (0.5 * (m + last_cycles_)) : 0.0;
      most_changed = std::max(most_changed, change * change);
      per_cycle_[j] = w;
    }
    const double least = c_.acceleration / (rate_ * rate_);
    change_ = last_cycles_ > 0 ? std::max(least * least, change_ + 0.05 * (std::min(most_changed, 9.0 * change_) - change_)) : 100.0 * least * least;
    last_cycles_ = m;
  }

  /// Of a standard normal number between a and b.
  static double share(double a, double b) noexcept { return 0.5 * (std::erfc(a / std::numbers::sqrt2) - std::erfc(b / std::numbers::sqrt2)); }

  /// log p(x | m cycles), up to a constant.
  [[nodiscard]] double motion(const JointVector& x, int m) const noexcept {
    const double noise = c_.position_std * (1.0 + static_cast<double>(m) / last_cycles_), between = m * 0.5 * (m + last_cycles_);
    const double variance = change_ * between * between + noise * noise;
    double sum = 0.0;
    for (std::size_t j = 0; j < n_; ++j) {
      const double r = x[j] - m * per_cycle_[j];
      sum -= 0.5 * (std::min(r * r / variance, 25.0) + std::log(variance));
    }
    return sum;
  }

  std::size_t n_;
  SenderClockConfig c_;
  Mode mode_ = Mode::empty;
  std::int64_t read_ns_ = 0;  // last look [ns]
  JointVector q_{};           // what was read there [rad]
  std::array<Look, window> ring_{};
  std::size_t looks_ = 0;

  double phase_ = 0.0;               // c - k at the last look: age of the sample read there [cycles]
  double rate_ = 0.0;                // c' = 1/T [cycles/s]
  std::array<double, 3> P_{};        // covariance of (phase, rate): 00, 01, 11
  JointVector per_cycle_{};          // last step per cycle [rad]
  int last_cycles_ = 0;
  double change_ = 0.0;              // of that, per cycle, mean square [rad^2]
  double doubts_ = 0.0;
  std::int64_t time_ns_ = 0;  // of the last sample [ns]
  SenderStamp out_{};
};

}  // namespace palpate
