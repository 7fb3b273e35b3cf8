// Histogram: durations counted by one thread, readable by others at any time.
#pragma once
#include <algorithm>
#include <array>
#include <atomic>
#include <bit>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace palpate {

/// Counts durations [ns] in 32 bins per power of two, so that a quantile is at most 1/32 too large and never too small.
/// One thread adds; any thread reads, and may miss what is being added just now.
class Histogram {
 public:
  /// ns [ns]; below 0 counts as 0.
  void add(std::int64_t ns) noexcept {
    const auto value = static_cast<std::uint64_t>(ns < 0 ? 0 : ns);
    std::atomic<std::uint64_t>& bin = bins_[index(value)];
    bin.store(bin.load(std::memory_order_relaxed) + 1, std::memory_order_relaxed);
    if (value > worst_.load(std::memory_order_relaxed)) worst_.store(value, std::memory_order_relaxed);
  }

  [[nodiscard]] std::uint64_t count() const noexcept {
    std::uint64_t sum = 0;
    for (const auto& bin : bins_) sum += bin.load(std::memory_order_relaxed);
    return sum;
  }
  /// Largest so far [ns], exact.
  [[nodiscard]] std::int64_t worst() const noexcept { return static_cast<std::int64_t>(worst_.load(std::memory_order_relaxed)); }
  /// The duration [ns] that a share p in [0, 1] of all did not exceed: upper edge of its bin; 0 if nothing was added.
  [[nodiscard]] std::int64_t quantile(double p) const noexcept {
    const std::uint64_t total = count();
    if (total == 0) return 0;
    const auto wanted = static_cast<std::uint64_t>(std::ceil(p * static_cast<double>(total)));
    std::uint64_t sum = 0;
    for (std::size_t i = 0; i < bins_.size(); ++i) {
      sum += bins_[i].load(std::memory_order_relaxed);
      if (sum >= wanted && sum > 0) return std::min(upper(i), worst());
    }
    return worst();
  }
  /// Upper edges [ns] of the bins that hold something, and how many each holds.
  [[nodiscard]] std::vector<std::array<std::uint64_t, 2>> bins() const {
    std::vector<std::array<std::uint64_t, 2>> out;
    for (std::size_t i = 0; i < bins_.size(); ++i)
      if (const std::uint64_t count = bins_[i].load(std::memory_order_relaxed); count > 0)
        out.push_back({static_cast<std::uint64_t>(upper(i)), count});
    return out;
  }

 private:
  static constexpr int bits = 5;                                // 2^5 bins per power of two
  static constexpr std::uint64_t first = std::uint64_t{1} << bits;  // below it every nanosecond has its bin
  static constexpr int powers = 36;                             // up to 2^(36 + 5) ns, 36 min
  static constexpr std::size_t size = first * (powers + 1);

  static constexpr std::size_t index(std::uint64_t value) noexcept {
    if (value < first) return static_cast<std::size_t>(value);
    const int power = std::bit_width(value) - bits - 1;  // value >> power lies in [32, 64)
    const std::uint64_t i = first * static_cast<std::uint64_t>(power) + (value >> power);
    return static_cast<std::size_t>(i < size ? i : size - 1);
  }
  static constexpr std::int64_t upper(std::size_t i) noexcept {
    if (i < first) return static_cast<std::int64_t>(i);
    const std::uint64_t power = i / first - 1, part = i % first + first;
    return static_cast<std::int64_t>(((part + 1) << power) - 1);
  }

  std::array<std::atomic<std::uint64_t>, size> bins_{};
  std::atomic<std::uint64_t> worst_{0};
};

}  // namespace palpate
