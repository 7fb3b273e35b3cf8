// Latest: the newest value from one thread to another, wait-free on both sides.
#pragma once
#include <array>
#include <atomic>
#include <cstdint>

namespace palpate {

/// Triple buffer between one writer and one reader thread. write() never waits for the reader, read() never for the writer,
/// and what is read was written as a whole: each side owns a slot, the third changes hands in one atomic exchange.
template <class T>
class Latest {
 public:
  Latest() = default;
  explicit Latest(const T& first) { slots_.fill(first); }

  /// Writer: replaces what was not read yet.
  void write(const T& value) noexcept {
    draft() = value;
    publish();
  }
  /// Writer: the same in two steps, the new value written in its place.
  [[nodiscard]] T& draft() noexcept { return slots_[back_]; }
  void publish() noexcept { back_ = middle_.exchange(static_cast<std::uint8_t>(back_ | fresh), std::memory_order_acq_rel) & slot; }

  /// Reader: the newest value; false if it is the one of the last read().
  bool read(T& out) noexcept {
    const bool newer = renew();
    out = newest();
    return newer;
  }
  /// Reader: the same in two steps, the value read in its place.
  bool renew() noexcept {
    const bool newer = (middle_.load(std::memory_order_relaxed) & fresh) != 0;
    if (newer) front_ = middle_.exchange(front_, std::memory_order_acq_rel) & slot;
    return newer;
  }
  [[nodiscard]] const T& newest() const noexcept { return slots_[front_]; }

 private:
  static constexpr std::uint8_t slot = 3, fresh = 4;
  std::array<T, 3> slots_{};
  std::uint8_t back_ = 0;               // the writer's
  std::atomic<std::uint8_t> middle_{1};
  std::uint8_t front_ = 2;              // the reader's
};

}  // namespace palpate
