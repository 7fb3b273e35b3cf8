// Ring: records from one thread to another, in order, wait-free on both sides.
#pragma once
#include <atomic>
#include <bit>
#include <cstddef>
#include <cstdint>
#include <stdexcept>
#include <vector>

namespace palpate {

/// Queue of fixed size between one producer and one consumer thread. push() and take() finish in a bounded number of steps
/// whatever the other side does. What does not fit is dropped, the newest first, and counted.
///
/// head_, tail_ count what was ever taken and pushed; both only grow, so that full and empty cannot be confused.
template <class T>
class Ring {
 public:
  /// capacity: at least so many fit; rounded up to a power of two. Throws std::invalid_argument if it is 0.
  explicit Ring(std::size_t capacity) : slots_(capacity == 0 ? throw std::invalid_argument("Ring: capacity must be > 0") : std::bit_ceil(capacity)) {}

  /// Producer: false if there was no room; then it is counted as dropped.
  bool push(const T& value) noexcept {
    const std::uint64_t tail = tail_.load(std::memory_order_relaxed);
    if (tail - head_seen_ == slots_.size()) {
      head_seen_ = head_.load(std::memory_order_acquire);
      if (tail - head_seen_ == slots_.size()) {
        dropped_.store(dropped_.load(std::memory_order_relaxed) + 1, std::memory_order_relaxed);
        return false;
      }
    }
    slots_[tail & (slots_.size() - 1)] = value;
    tail_.store(tail + 1, std::memory_order_release);
    return true;
  }

  /// Consumer: the oldest is copied to `out`; false if there is none.
  bool take(T& out) noexcept {
    const std::uint64_t head = head_.load(std::memory_order_relaxed);
    if (head == tail_.load(std::memory_order_acquire)) return false;
    out = slots_[head & (slots_.size() - 1)];
    head_.store(head + 1, std::memory_order_release);
    return true;
  }

  /// How many wait to be taken; for the consumer exact or too few, for the producer exact or too many.
  [[nodiscard]] std::size_t size() const noexcept {
    const std::uint64_t head = head_.load(std::memory_order_acquire);  // first: it never overtakes the tail
    return static_cast<std::size_t>(tail_.load(std::memory_order_acquire) - head);
  }
  [[nodiscard]] std::size_t capacity() const noexcept { return slots_.size(); }
  /// How many did not fit so far. Any thread.
  [[nodiscard]] std::uint64_t dropped() const noexcept { return dropped_.load(std::memory_order_relaxed); }

 private:
  std::vector<T> slots_;
  // each side's counters on a cache line of their own: else every push would wait for the other core
  alignas(64) std::atomic<std::uint64_t> tail_{0};
  std::uint64_t head_seen_ = 0;  // by the producer
  std::atomic<std::uint64_t> dropped_{0};
  alignas(64) std::atomic<std::uint64_t> head_{0};
};

}  // namespace palpate
