// Ring: records from one thread to another, in order, wait-free on both sides.
#pragma once
#include <atomic>
#include <bit>
#include <cstddef>
#include <cstdint>
#include <stdexcept>
#include <vector>

namespace palpate {

/// Queue of fixed size between one producer and one consumer thread, of records of so many bytes each, written and read in
/// their places. All four calls finish in a bounded number of steps whatever the other side does. What does not fit is
/// dropped, the newest first, and counted.
///
/// head_, tail_ count what was ever taken and pushed; both only grow, so that full and empty cannot be confused.
class Ring {
 public:
  /// capacity: at least so many fit; rounded up to a power of two. bytes: of a record; rounded up so that no two share a
  /// cache line. Throws std::invalid_argument if either is 0.
  Ring(std::size_t capacity, std::size_t bytes)
      : capacity_(std::bit_ceil(positive(capacity))), stride_((positive(bytes) + line - 1) / line * line), storage_(capacity_ * stride_ + line) {
    const std::size_t past = reinterpret_cast<std::uintptr_t>(storage_.data()) % line;
    slots_ = storage_.data() + (past == 0 ? 0 : line - past);
  }
  Ring(const Ring&) = delete;
  Ring& operator=(const Ring&) = delete;

  /// Producer: where the next record is to be written; nullptr if there is no room, which is counted as dropped.
  [[nodiscard]] std::byte* draft() noexcept {
    const std::uint64_t tail = tail_.load(std::memory_order_relaxed);
    if (tail - head_seen_ == capacity_) {
      head_seen_ = head_.load(std::memory_order_acquire);
      if (tail - head_seen_ == capacity_) {
        dropped_.store(dropped_.load(std::memory_order_relaxed) + 1, std::memory_order_relaxed);
        return nullptr;
      }
    }
    return slot(tail);
  }
  /// Producer: hands over what was written to draft().
  void push() noexcept { tail_.store(tail_.load(std::memory_order_relaxed) + 1, std::memory_order_release); }

  /// Consumer: the oldest; nullptr if there is none.
  [[nodiscard]] const std::byte* front() const noexcept {
    const std::uint64_t head = head_.load(std::memory_order_relaxed);
    return head == tail_.load(std::memory_order_acquire) ? nullptr : slot(head);
  }
  /// Consumer: gives the place of front() back.
  void pop() noexcept { head_.store(head_.load(std::memory_order_relaxed) + 1, std::memory_order_release); }

  /// How many wait to be taken; for the consumer exact or too few, for the producer exact or too many.
  [[nodiscard]] std::size_t size() const noexcept {
    const std::uint64_t head = head_.load(std::memory_order_acquire);  // first: it never overtakes the tail
    return static_cast<std::size_t>(tail_.load(std::memory_order_acquire) - head);
  }
  [[nodiscard]] std::size_t capacity() const noexcept { return capacity_; }
  /// How many did not fit so far. Any thread.
  [[nodiscard]] std::uint64_t dropped() const noexcept { return dropped_.load(std::memory_order_relaxed); }
  /// The one that was pushed `age` before the newest, taken or not; nullptr: there is none any more. Only once the producer
  /// writes no more.
  [[nodiscard]] const std::byte* back(std::size_t age) const noexcept {
    const std::uint64_t tail = tail_.load(std::memory_order_acquire);
    return age < tail && age < capacity_ ? slot(tail - 1 - age) : nullptr;
  }

 private:
  static constexpr std::size_t line = 64;  // of a cache [bytes]
  static std::size_t positive(std::size_t n) {
    return n > 0 ? n : throw std::invalid_argument("Ring: capacity and bytes must be > 0");
  }
  [[nodiscard]] std::byte* slot(std::uint64_t n) const noexcept { return slots_ + (n & (capacity_ - 1)) * stride_; }

  std::size_t capacity_, stride_;
  std::vector<std::byte> storage_;  // zeroed, so that every page is there before the first tick
  std::byte* slots_;
  // each side's counters on a cache line of their own: else every push would wait for the other core
  alignas(64) std::atomic<std::uint64_t> tail_{0};
  std::uint64_t head_seen_ = 0;  // by the producer
  std::atomic<std::uint64_t> dropped_{0};
  alignas(64) std::atomic<std::uint64_t> head_{0};
};

}  // namespace palpate
