// Low-pass filters and differentiators over one or many channels; every one of them copes with irregular time stamps
// or says for which period it was built.
//
// Shared rules. Channels is the capacity (max_joints by default), n <= Channels the number in use; entries beyond n
// stay zero. step() returns the new output and keeps it as value(); status() judges that step: an input that is not
// finite (non_finite) or an impossible time step (time_error) is not used, the state and the output stay as they were.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <complex>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <numbers>

#include "palpate/check.hpp"
#include "palpate/status.hpp"
#include "palpate/types.hpp"

namespace palpate {

/// Time from one stamp [ns] to a later one, in [s]. Unsigned difference: right for any two stamps, where the signed one
/// could overflow; division: 100 ms are exactly the double 0.1.
inline double seconds_between(std::int64_t earlier_ns, std::int64_t later_ns) noexcept {
  return static_cast<double>(static_cast<std::uint64_t>(later_ns) - static_cast<std::uint64_t>(earlier_ns)) / 1e9;
}

/// State of a filter before its first input.
enum class Start {
  first_input,  ///< as if the first input had been there for ever: no transient
  zero,         ///< output and all states zero
};

/// How a first-order lag becomes a difference equation.
enum class Lag {
  exact,      ///< a = 1 - exp(-h/tau): the solution of tau y' = x - y for x held during h
  published,  ///< a = h/(h + tau): backward Euler, the whiteboard project's form (MATH.md section 8)
};

/// First-order low-pass  tau y' = x - y,  as  y <- (1 - a) y + a x  with a from the actual time step (see Lag).
///
/// x [any unit] input, held during the interval h = dt [s] that ends with it; y output; tau [s] time constant
/// (cutoff 1/tau [rad/s]); tau = 0 passes the input through.
template <int Channels = max_joints>
class FirstOrder {
 public:
  using Array = std::array<double, static_cast<std::size_t>(Channels)>;

  FirstOrder(int n, double time_constant, Lag lag = Lag::exact, Start start = Start::first_input)
      : n_(static_cast<std::size_t>(check::in_range("FirstOrder n", n, 1, Channels))),
        tau_(check::not_negative("FirstOrder time_constant [s]", time_constant)),
        lag_(lag),
        start_(start) {
    reset();
  }

  const Array& step(const Array& x, double dt) noexcept {
    if (!check::all_finite(x, n_)) return rejected(Status::non_finite);
    if (!(dt >= 0.0 && std::isfinite(dt))) return rejected(Status::time_error);
    const double a = fresh_ ? 1.0 : weight(dt);
    fresh_ = false;
    for (std::size_t j = 0; j < n_; ++j) y_[j] = a == 1.0 ? x[j] : y_[j] + a * (x[j] - y_[j]);
    status_ = Status::ok;
    return y_;
  }

  double step(double x, double dt) noexcept
    requires(Channels == 1)
  {
    return step(Array{x}, dt)[0];
  }

  [[nodiscard]] const Array& value() const noexcept { return y_; }
  [[nodiscard]] Status status() const noexcept { return status_; }

  void reset() noexcept {
    y_ = {};
    fresh_ = start_ == Start::first_input;
    status_ = Status::warming;
  }

 private:
  const Array& rejected(Status why) noexcept {
    status_ = why;
    return y_;
  }

  [[nodiscard]] double weight(double dt) const noexcept {
    if (tau_ == 0.0) return 1.0;
    return lag_ == Lag::exact ? -std::expm1(-dt / tau_) : dt / (dt + tau_);
  }

  std::size_t n_;
  double tau_;
  Lag lag_;
  Start start_;
  Array y_{};
  bool fresh_ = true;  // the next input becomes the output
  Status status_ = Status::warming;
};

/// Mean of the last `window` inputs; of those seen so far (status warming) until there are that many.
///
/// y = x_k + (1/m) sum_i (x_i - x_k), m = inputs in the window, x_k the newest. Summing differences anew at each step
/// keeps a constant exact and lets no rounding error pile up, as a running sum would. Delay: (window - 1)/2 samples.
template <int Capacity, int Channels = max_joints>
class MovingAverage {
 public:
  using Array = std::array<double, static_cast<std::size_t>(Channels)>;

  MovingAverage(int n, int window)
      : n_(static_cast<std::size_t>(check::in_range("MovingAverage n", n, 1, Channels))),
        window_(static_cast<std::size_t>(check::in_range("MovingAverage window [samples]", window, 1, Capacity))) {}

  const Array& step(const Array& x) noexcept {
    if (!check::all_finite(x, n_)) {
      status_ = Status::non_finite;
      return y_;
    }
    newest_ = (newest_ + 1) % window_;
    past_[newest_] = x;
    count_ = std::min(count_ + 1, window_);
    Array sum{};
    for (std::size_t i = 1; i < count_; ++i) {  // newest to oldest: the result does not depend on where the ring starts
      const Array& old = past_[(newest_ + window_ - i) % window_];
      for (std::size_t j = 0; j < n_; ++j) sum[j] += old[j] - x[j];
    }
    const double m = static_cast<double>(count_);
    for (std::size_t j = 0; j < n_; ++j) y_[j] = x[j] + sum[j] / m;
    status_ = count_ < window_ ? Status::warming : Status::ok;
    return y_;
  }

  double step(double x) noexcept
    requires(Channels == 1)
  {
    return step(Array{x})[0];
  }

  [[nodiscard]] const Array& value() const noexcept { return y_; }
  [[nodiscard]] Status status() const noexcept { return status_; }

  void reset() noexcept {
    y_ = {};
    count_ = 0;
    newest_ = 0;
    status_ = Status::warming;
  }

 private:
  std::size_t n_;
  std::size_t window_;
  std::array<Array, static_cast<std::size_t>(Capacity)> past_{};
  Array y_{};
  std::size_t count_ = 0;
  std::size_t newest_ = 0;
  Status status_ = Status::warming;
};

/// Butterworth low-pass  |H(j w)|^2 = 1 / (1 + (w/w_c)^(2 N)),  poles  p_k = w_c exp(j (pi/2 + a_k)),
/// a_k = (2 k - 1) pi / (2 N), k = 1..N; as sections of second order  s^2 + 2 sin(a_k) w_c s + w_c^2, k = 1..N/2, and
/// one of first order  s + w_c  if N is odd.
///
/// N order [1], w_c cutoff [rad/s]. The unit is part of the constructor's name because the mass-estimation report says
/// 1 Hz where its model has 1 rad/s (MATH.md section 1, R3). This is the design; BilinearButterworth and
/// HeldButterworth run it.
class Butterworth {
 public:
  static constexpr int max_order = 8;
  static constexpr int max_pairs = max_order / 2;

  static Butterworth from_rad_per_s(int order, double cutoff) { return {order, check::positive("Butterworth cutoff [rad/s]", cutoff)}; }
  static Butterworth from_hz(int order, double cutoff) {
    return {order, 2.0 * std::numbers::pi * check::positive("Butterworth cutoff [Hz]", cutoff)};
  }

  [[nodiscard]] int order() const noexcept { return order_; }
  [[nodiscard]] double cutoff_rad_per_s() const noexcept { return cutoff_; }
  [[nodiscard]] double cutoff_hz() const noexcept { return cutoff_ / (2.0 * std::numbers::pi); }
  [[nodiscard]] int pairs() const noexcept { return order_ / 2; }        ///< second-order sections
  [[nodiscard]] bool has_real_pole() const noexcept { return order_ % 2 == 1; }

  /// Angle a_k [rad] of pole pair k = 0..pairs()-1 from the imaginary axis; its damping ratio is sin(a_k).
  [[nodiscard]] double angle(int k) const noexcept { return (2 * k + 1) * std::numbers::pi / (2 * order_); }

 private:
  Butterworth(int order, double cutoff) : order_(check::in_range("Butterworth order", order, 1, max_order)), cutoff_(cutoff) {}

  int order_;
  double cutoff_;
};

/// Whether the bilinear transform keeps the cutoff frequency.
enum class Warp {
  prewarped,  ///< g = tan(w_c h/2): the gain at w_c is exactly -3 dB
  plain,      ///< g = w_c h/2: the trapezoidal rule; the cutoff sinks to (2/h) atan(w_c h/2)
};

/// Butterworth for one fixed period: bilinear transform of each section, s = (w_c/g) (1 - z^-1)/(1 + z^-1).
///
/// Each section is kept as two trapezoidal integrators (state-variable form, A. Simper, "Linear trapezoidal state
/// variable filter", 2013): same transfer function as the usual b0..a2, but the steady state is exact and cutoffs far
/// below the sample rate lose no digits. With k = 2 sin(a):
///   v1 = (s1 + g (x - s2)) / (1 + g (g + k)),  y = s2 + g v1,  s1 <- 2 v1 - s1,  s2 <- 2 y - s2.
/// h period [s], w_c cutoff [rad/s], x input and y output of the section, s1, s2 its states, all in the input's unit.
template <int Channels = max_joints>
class BilinearButterworth {
 public:
  using Array = std::array<double, static_cast<std::size_t>(Channels)>;

  BilinearButterworth(const Butterworth& design, int n, double period, Warp warp = Warp::prewarped, Start start = Start::first_input)
      : n_(static_cast<std::size_t>(check::in_range("BilinearButterworth n", n, 1, Channels))),
        pairs_(static_cast<std::size_t>(design.pairs())),
        real_(design.has_real_pole()),
        start_(start) {
    const double half_angle = 0.5 * design.cutoff_rad_per_s() * check::positive("BilinearButterworth period [s]", period);
    if (half_angle >= 0.5 * std::numbers::pi)
      check::fail("Butterworth cutoff [Hz]", design.cutoff_hz(), "less than half the sample rate, " + std::to_string(0.5 / period) + " Hz");
    g_ = warp == Warp::prewarped ? std::tan(half_angle) : half_angle;
    for (std::size_t s = 0; s < pairs_; ++s) scale_[s] = 1.0 / (1.0 + g_ * (g_ + 2.0 * std::sin(design.angle(static_cast<int>(s)))));
    reset();
  }

  const Array& step(const Array& x) noexcept {
    if (!check::all_finite(x, n_)) {
      status_ = Status::non_finite;
      return y_;
    }
    if (fresh_) {
      fresh_ = false;
      for (auto& s : s2_) std::copy_n(x.begin(), n_, s.begin());
      std::copy_n(x.begin(), n_, s_real_.begin());
    }
    std::copy_n(x.begin(), n_, y_.begin());
    for (std::size_t s = 0; s < pairs_; ++s) {
      for (std::size_t j = 0; j < n_; ++j) {
        const double v1 = (s1_[s][j] + g_ * (y_[j] - s2_[s][j])) * scale_[s];
        y_[j] = s2_[s][j] + g_ * v1;
        s1_[s][j] = 2.0 * v1 - s1_[s][j];
        s2_[s][j] = 2.0 * y_[j] - s2_[s][j];
      }
    }
    if (real_) {
      const double a = g_ / (1.0 + g_);
      for (std::size_t j = 0; j < n_; ++j) {
        const double v = a * (y_[j] - s_real_[j]);
        y_[j] = s_real_[j] + v;
        s_real_[j] = y_[j] + v;
      }
    }
    status_ = Status::ok;
    return y_;
  }

  double step(double x) noexcept
    requires(Channels == 1)
  {
    return step(Array{x})[0];
  }

  [[nodiscard]] const Array& value() const noexcept { return y_; }
  [[nodiscard]] Status status() const noexcept { return status_; }

  void reset() noexcept {
    s1_ = {};
    s2_ = {};
    s_real_ = {};
    y_ = {};
    fresh_ = start_ == Start::first_input;
    status_ = Status::warming;
  }

 private:
  std::size_t n_;
  std::size_t pairs_;
  bool real_;
  Start start_;
  double g_ = 0.0;
  std::array<double, Butterworth::max_pairs> scale_{};
  std::array<Array, Butterworth::max_pairs> s1_{}, s2_{};
  Array s_real_{};
  Array y_{};
  bool fresh_ = true;
  Status status_ = Status::warming;
};

/// Butterworth for any sequence of time steps: the continuous filter, integrated exactly while the input is held.
///
/// Partial fractions: all N poles are distinct, so H(s) = sum_k -c_k p_k/(s - p_k), sum_k c_k = 1 and
/// c_k = -1/(p_k prod_{i != k} (p_k - p_i)) for w_c = 1. Mode k's deviation d_k from its steady state obeys d_k' = p_k d_k
/// while x is held, hence per step  d_k <- exp(p_k h) (d_k + x_old - x),  y = x + sum_k Re(c_k d_k).
/// The whole cascade is exact, not just each section; steps of any length may be split without changing the result.
/// h = dt [s]; x input, held during the interval that ends with it; y output; d_k in the input's unit.
template <int Channels = max_joints>
class HeldButterworth {
 public:
  using Array = std::array<double, static_cast<std::size_t>(Channels)>;

  HeldButterworth(const Butterworth& design, int n, Start start = Start::first_input)
      : n_(static_cast<std::size_t>(check::in_range("HeldButterworth n", n, 1, Channels))),
        modes_(static_cast<std::size_t>(design.pairs() + (design.has_real_pole() ? 1 : 0))),
        start_(start) {
    using Complex = std::complex<double>;
    std::array<Complex, Butterworth::max_order> pole{};  // pairs first: p, conj p; then the real one; w_c = 1
    const std::size_t order = static_cast<std::size_t>(design.order());
    const std::size_t pairs = static_cast<std::size_t>(design.pairs());
    for (std::size_t k = 0; k < pairs; ++k) {
      const double a = design.angle(static_cast<int>(k));
      pole[2 * k] = Complex(-std::sin(a), std::cos(a));
      pole[2 * k + 1] = std::conj(pole[2 * k]);
    }
    if (design.has_real_pole()) pole[order - 1] = -1.0;
    for (std::size_t m = 0; m < modes_; ++m) {
      const std::size_t k = 2 * m;
      Complex c = -1.0 / pole[k];
      for (std::size_t i = 0; i < order; ++i)
        if (i != k) c /= pole[k] - pole[i];
      if (m < pairs) c *= 2.0;  // the conjugate mode adds the same real part
      gain_[m] = {c.real(), c.imag()};
      rate_[m] = {design.cutoff_rad_per_s() * pole[k].real(), design.cutoff_rad_per_s() * pole[k].imag()};
    }
    reset();
  }

  const Array& step(const Array& x, double dt) noexcept {
    if (!check::all_finite(x, n_)) return rejected(Status::non_finite);
    if (!(dt >= 0.0 && std::isfinite(dt))) return rejected(Status::time_error);
    if (fresh_) {
      fresh_ = false;
      std::copy_n(x.begin(), n_, x_.begin());
    }
    if (dt != factor_dt_) {
      for (std::size_t m = 0; m < modes_; ++m) {
        const double decay = std::exp(rate_[m].re * dt);
        factor_[m] = {};
        if (decay > 0.0) factor_[m] = {decay * std::cos(rate_[m].im * dt), decay * std::sin(rate_[m].im * dt)};
      }
      factor_dt_ = dt;
    }
    Array change{};
    for (std::size_t j = 0; j < n_; ++j) {
      change[j] = x_[j] - x[j];
      x_[j] = y_[j] = x[j];
    }
    for (std::size_t m = 0; m < modes_; ++m) {
      const Pair f = factor_[m], c = gain_[m];
      for (std::size_t j = 0; j < n_; ++j) {
        const double re = re_[m][j] + change[j], im = im_[m][j];
        re_[m][j] = f.re * re - f.im * im;
        im_[m][j] = f.im * re + f.re * im;
        y_[j] += c.re * re_[m][j] - c.im * im_[m][j];
      }
    }
    status_ = Status::ok;
    return y_;
  }

  double step(double x, double dt) noexcept
    requires(Channels == 1)
  {
    return step(Array{x}, dt)[0];
  }

  [[nodiscard]] const Array& value() const noexcept { return y_; }
  [[nodiscard]] Status status() const noexcept { return status_; }

  void reset() noexcept {
    re_ = {};
    im_ = {};
    x_ = {};
    y_ = {};
    fresh_ = start_ == Start::first_input;
    status_ = Status::warming;
  }

 private:
  struct Pair {
    double re = 0.0, im = 0.0;
  };

  const Array& rejected(Status why) noexcept {
    status_ = why;
    return y_;
  }

  std::size_t n_;
  std::size_t modes_;
  Start start_;
  std::array<Pair, Butterworth::max_pairs> gain_{}, rate_{}, factor_{};  // c_k (twice for a pair), p_k [1/s], exp(p_k dt)
  double factor_dt_ = -1.0;                                             // the dt factor_ was computed for [s]
  std::array<Array, Butterworth::max_pairs> re_{}, im_{};               // d_k
  Array x_{};
  Array y_{};
  bool fresh_ = true;
  Status status_ = Status::warming;
};

struct DifferentiatorConfig {
  int points = 2;              ///< samples in the slope, 2 to Differentiator<>::max_points; 2: plain difference
  double time_constant = 0.0;  ///< of the first-order low-pass behind it [s]; 0: none
  Lag lag = Lag::exact;        ///< how that low-pass is discretised
};

/// Velocity from positions and their own time stamps: least-squares slope over the last m samples,
///   v = sum_i (t_i - t_mean) (q_i - q_k) / S,  S = sum_i (t_i - t_mean)^2,
/// for m = 2 the plain difference (q_k - q_{k-1})/(t_k - t_{k-1}); then optionally a first-order low-pass.
///
/// q [rad], t [s], v [rad/s], k the newest sample. The slope belongs to t_mean: it is (m - 1)/2 samples late.
/// The first sample has no velocity (status warming, value zero): differencing it from 0 is the whiteboard project's
/// erratum 5. Fewer than `points` samples give a slope over what there is, still with status warming.
/// A time stamp that does not increase is time_error and changes nothing.
template <int Channels = max_joints>
class Differentiator {
 public:
  static constexpr int max_points = 16;
  using Array = std::array<double, static_cast<std::size_t>(Channels)>;

  explicit Differentiator(int n, const DifferentiatorConfig& config = {})
      : n_(static_cast<std::size_t>(check::in_range("Differentiator n", n, 1, Channels))),
        points_(static_cast<std::size_t>(check::in_range("Differentiator points", config.points, 2, max_points))),
        low_pass_(n, config.time_constant, config.lag) {}

  const Array& step(std::int64_t time_ns, const Array& q) noexcept {
    if (!check::all_finite(q, n_)) {
      status_ = Status::non_finite;
      return v_;
    }
    if (count_ > 0 && time_ns <= time_[newest_]) {
      status_ = Status::time_error;
      return v_;
    }
    const double dt = count_ > 0 ? seconds_between(time_[newest_], time_ns) : 0.0;
    newest_ = (newest_ + 1) % points_;
    time_[newest_] = time_ns;
    position_[newest_] = q;
    count_ = std::min(count_ + 1, points_);
    status_ = count_ < points_ ? Status::warming : Status::ok;
    if (count_ < 2) return v_;
    v_ = low_pass_.step(slope(dt), dt);
    return v_;
  }

  [[nodiscard]] const Array& value() const noexcept { return v_; }
  [[nodiscard]] Status status() const noexcept { return status_; }

  /// Standard deviation of the slope per standard deviation of the positions, 1/sqrt(S) [1/s], low-pass not counted;
  /// infinite before there is a slope.
  [[nodiscard]] double noise_gain() const noexcept { return noise_gain_; }

  void reset() noexcept {
    v_ = {};
    count_ = 0;
    newest_ = 0;
    noise_gain_ = std::numeric_limits<double>::infinity();
    low_pass_.reset();
    status_ = Status::warming;
  }

 private:
  [[nodiscard]] std::size_t ago(std::size_t i) const noexcept { return (newest_ + points_ - i) % points_; }

  Array slope(double dt) noexcept {
    const Array& now = position_[newest_];
    Array v{};
    if (count_ == 2) {
      const Array& before = position_[ago(1)];
      for (std::size_t j = 0; j < n_; ++j) v[j] = (now[j] - before[j]) / dt;
      noise_gain_ = std::numbers::sqrt2 / dt;
      return v;
    }
    std::array<double, max_points> age{};  // [s] before the newest sample
    double mean = 0.0;
    for (std::size_t i = 1; i < count_; ++i) mean += age[i] = seconds_between(time_[ago(i)], time_[newest_]);
    mean /= static_cast<double>(count_);
    double S = mean * mean;
    for (std::size_t i = 1; i < count_; ++i) S += (age[i] - mean) * (age[i] - mean);
    for (std::size_t i = 1; i < count_; ++i) {
      const Array& old = position_[ago(i)];
      const double w = (mean - age[i]) / S;
      for (std::size_t j = 0; j < n_; ++j) v[j] += w * (old[j] - now[j]);
    }
    noise_gain_ = 1.0 / std::sqrt(S);
    return v;
  }

  std::size_t n_;
  std::size_t points_;
  FirstOrder<Channels> low_pass_;
  std::array<std::int64_t, max_points> time_{};  // [ns]
  std::array<Array, max_points> position_{};
  Array v_{};
  std::size_t count_ = 0;
  std::size_t newest_ = 0;
  double noise_gain_ = std::numeric_limits<double>::infinity();
  Status status_ = Status::warming;
};

}  // namespace palpate
