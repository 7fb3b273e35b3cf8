// Messages of KUKA's Fast Robot Interface (FRI 1.15 and 2.5), as far as they are used: read from and written to protobuf's wire format.
//
// Numbers of fields are public facts that were never checked against a KUKA controller. What else a message holds is
// passed over. Wire format: protobuf.dev/programming-guides/encoding.
#pragma once
#include <array>
#include <bit>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <span>

#include "palpate/types.hpp"

namespace palpate::fri {

inline constexpr std::size_t max_bytes = 1500;  ///< of a datagram
inline constexpr std::uint32_t monitoring_id = 0x245142, command_id = 0x34001;
inline constexpr int commanding_wait = 3, commanding_active = 4;                ///< session states
inline constexpr int mode_position = 1, mode_wrench = 2, mode_torque = 3;  ///< client command modes

/// Numbers of one repeated field; `count` also counts what was beyond the room.
struct Values {
  JointVector value{};
  int count = 0;
  void add(double x) noexcept {
    if (count < max_joints) value[static_cast<std::size_t>(count)] = x;
    ++count;
  }
  [[nodiscard]] bool are(int n) const noexcept {
    if (count != n) return false;
    for (int i = 0; i < n; ++i)
      if (!std::isfinite(value[static_cast<std::size_t>(i)])) return false;
    return true;
  }
};

/// What the controller tells in every cycle.
struct Monitoring {
  std::uint32_t id = 0, sequence = 0;
  std::int32_t safety_state = 0, control_mode = 0;
  std::array<std::int32_t, max_joints> drive_state{};
  int drives = 0;
  Values position, torque, external;    ///< measured [rad], measured [N m], the controller's estimate [N m]
  std::uint32_t seconds = 0, nanoseconds = 0;  ///< time of the measurement
  std::int32_t session_state = 0, quality = 0;
  std::uint32_t send_period = 0;        ///< [ms]
  std::uint32_t receive_multiplier = 0; ///< every which message wants an answer
  Values interpolated;                  ///< position of the robot program's own motion [rad]
  std::int32_t command_mode = 0;
  [[nodiscard]] std::int64_t time_ns() const noexcept { return std::int64_t{seconds} * 1'000'000'000 + nanoseconds; }
};

namespace detail {

/// A message's fields, one by one.
class Reader {
 public:
  explicit Reader(std::span<const std::uint8_t> data) noexcept : at_(data.data()), end_(data.data() + data.size()) {}

  /// The next field; false at the end and where the bytes are none (then !good()).
  bool next() noexcept {
    if (!good_ || at_ == end_) return false;
    std::uint64_t key = 0;
    if (!varint(key) || key > 0xFFFFFFFFu || (key >> 3) == 0) return good_ = false;
    field_ = static_cast<std::uint32_t>(key >> 3);
    wire_ = static_cast<int>(key & 7);
    switch (wire_) {
      case 0: return varint(number_) || (good_ = false);
      case 1: return fixed(8);
      case 5: return fixed(4);
      case 2: {
        std::uint64_t size = 0;
        if (!varint(size) || size > static_cast<std::uint64_t>(end_ - at_)) return good_ = false;
        data_ = {at_, static_cast<std::size_t>(size)};
        at_ += size;
        return true;
      }
      default: return good_ = false;  // groups have no place in these messages
    }
  }
  [[nodiscard]] bool good() const noexcept { return good_; }
  [[nodiscard]] bool is(std::uint32_t field, int wire) const noexcept { return field_ == field && wire_ == wire; }
  [[nodiscard]] std::uint64_t number() const noexcept { return number_; }
  [[nodiscard]] std::span<const std::uint8_t> data() const noexcept { return data_; }

  template <class T>
  void read(std::uint32_t field, T& out) const noexcept {
    if (is(field, 0)) out = static_cast<T>(static_cast<std::uint32_t>(number_));
  }

 private:
  bool varint(std::uint64_t& out) noexcept {
    out = 0;
    for (int shift = 0; shift < 70 && at_ != end_; shift += 7) {
      const std::uint8_t byte = *at_++;
      if (shift < 64) out |= static_cast<std::uint64_t>(byte & 0x7F) << shift;
      if (byte < 0x80) return true;
    }
    return false;
  }
  bool fixed(std::size_t size) noexcept {
    if (static_cast<std::size_t>(end_ - at_) < size) return good_ = false;
    number_ = 0;
    for (std::size_t i = 0; i < size; ++i) number_ |= static_cast<std::uint64_t>(at_[i]) << (8 * i);  // little-endian
    at_ += size;
    return true;
  }

  const std::uint8_t* at_;
  const std::uint8_t* end_;
  std::uint32_t field_ = 0;
  int wire_ = 0;
  std::uint64_t number_ = 0;
  std::span<const std::uint8_t> data_;
  bool good_ = true;
};

/// Calls `take` for every field of the message in `data`; false if the bytes are none.
template <class Take>
bool each(std::span<const std::uint8_t> data, Take&& take) noexcept {
  Reader r(data);
  while (r.next())
    if (!take(r)) return false;
  return r.good();
}

/// A message whose field 1 repeats a double, packed or not.
inline bool doubles(std::span<const std::uint8_t> data, Values& out) noexcept {
  return each(data, [&](const Reader& r) {
    if (r.is(1, 1)) out.add(std::bit_cast<double>(r.number()));
    if (!r.is(1, 2)) return true;
    const auto packed = r.data();
    if (packed.size() % 8 != 0) return false;
    for (std::size_t i = 0; i < packed.size(); i += 8) {
      std::uint64_t bits = 0;
      for (std::size_t k = 0; k < 8; ++k) bits |= static_cast<std::uint64_t>(packed[i + k]) << (8 * k);
      out.add(std::bit_cast<double>(bits));
    }
    return true;
  });
}

inline void drive(std::uint64_t state, Monitoring& out) noexcept {
  if (out.drives < max_joints) out.drive_state[static_cast<std::size_t>(out.drives)] = static_cast<std::int32_t>(static_cast<std::uint32_t>(state));
  ++out.drives;
}

/// Packed states of drives.
inline bool drives(std::span<const std::uint8_t> packed, Monitoring& out) noexcept {
  while (!packed.empty()) {
    std::uint64_t value = 0;
    std::size_t i = 0;
    for (; i < packed.size() && i < 10; ++i) {
      if (i < 9 || packed[i] <= 1) value |= static_cast<std::uint64_t>(packed[i] & 0x7F) << (7 * i);
      if (packed[i] < 0x80) break;
    }
    if (i == packed.size() || i == 10) return false;
    drive(value, out);
    packed = packed.subspan(i + 1);
  }
  return true;
}

/// Writes fields into room that is known to be enough.
class Writer {
 public:
  explicit Writer(std::uint8_t* out) noexcept : begin_(out), at_(out) {}
  void varint(std::uint64_t value) noexcept {
    for (; value > 0x7F; value >>= 7) *at_++ = static_cast<std::uint8_t>(value | 0x80);
    *at_++ = static_cast<std::uint8_t>(value);
  }
  void number(std::uint32_t field, std::uint32_t value) noexcept { varint(field << 3), varint(value); }
  void fixed32(std::uint32_t field, std::uint32_t value) noexcept { varint(field << 3 | 5), bytes(value, 4); }
  void block(std::uint32_t field, const Writer& inner) noexcept {
    varint(field << 3 | 2), varint(inner.size());
    std::memcpy(at_, inner.begin_, inner.size());
    at_ += inner.size();
  }
  /// A message whose field 1 repeats a double, each with its own key, proto2's default.
  void doubles(std::uint32_t field, std::span<const double> values) noexcept {
    varint(field << 3 | 2), varint(9 * values.size());
    for (const double x : values) varint(1 << 3 | 1), bytes(std::bit_cast<std::uint64_t>(x), 8);
  }
  [[nodiscard]] std::size_t size() const noexcept { return static_cast<std::size_t>(at_ - begin_); }

 private:
  void bytes(std::uint64_t value, int count) noexcept {
    for (int i = 0; i < count; ++i) *at_++ = static_cast<std::uint8_t>(value >> (8 * i));
  }
  std::uint8_t* begin_;
  std::uint8_t* at_;
};

}  // namespace detail

/// A monitoring message from its bytes; false if they are none in protobuf's format.
inline bool decode(std::span<const std::uint8_t> data, Monitoring& out) noexcept {
  using detail::each, detail::doubles, detail::Reader;
  out = {};
  return each(data, [&](const Reader& message) {
    if (message.is(1, 2)) return each(message.data(), [&](const Reader& r) {
      if (r.is(1, 5)) out.id = static_cast<std::uint32_t>(r.number());
      r.read(2, out.sequence);
      return true;
    });
    if (message.is(2, 2)) return each(message.data(), [&](const Reader& r) {
      r.read(2, out.safety_state);
      if (r.is(5, 0)) detail::drive(r.number(), out);
      r.read(7, out.control_mode);
      return !r.is(5, 2) || detail::drives(r.data(), out);
    });
    if (message.is(3, 2)) return each(message.data(), [&](const Reader& r) {
      if (r.is(1, 2)) return doubles(r.data(), out.position);
      if (r.is(2, 2)) return doubles(r.data(), out.torque);
      if (r.is(5, 2)) return doubles(r.data(), out.external);
      return !r.is(15, 2) || each(r.data(), [&](const Reader& t) {
        t.read(1, out.seconds);
        t.read(2, out.nanoseconds);
        return true;
      });
    });
    if (message.is(4, 2)) return each(message.data(), [&](const Reader& r) {
      r.read(1, out.session_state);
      r.read(2, out.quality);
      r.read(3, out.send_period);
      r.read(4, out.receive_multiplier);
      return true;
    });
    return !message.is(5, 2) || each(message.data(), [&](const Reader& r) {
      r.read(10, out.command_mode);
      return !r.is(1, 2) || doubles(r.data(), out.interpolated);
    });
  });
}

/// Whether a message is one of a controller whose robot has n joints, with numbers that can be used.
[[nodiscard]] inline bool usable(const Monitoring& m, int n) noexcept {
  return m.id == monitoring_id && m.session_state >= 1 && m.session_state <= commanding_active && m.position.are(n) && m.torque.are(n) &&
         (m.session_state < commanding_wait || m.interpolated.are(n));
}

/// What the client answers.
struct Answer {
  std::uint32_t sequence = 0, reflected = 0;
  std::span<const double> position, torque, wrench;  ///< empty: not in it
};

/// Its bytes, at most max_bytes; how many.
inline std::size_t encode(const Answer& answer, std::array<std::uint8_t, max_bytes>& out) noexcept {
  std::array<std::uint8_t, max_bytes> room;
  detail::Writer message(out.data());
  detail::Writer header(room.data());
  header.fixed32(1, command_id);
  header.number(2, answer.sequence);
  header.number(3, answer.reflected);
  message.block(1, header);
  if (!answer.position.empty() || !answer.torque.empty() || !answer.wrench.empty()) {
    detail::Writer data(room.data());
    if (!answer.position.empty()) data.doubles(1, answer.position);
    if (!answer.wrench.empty()) data.doubles(2, answer.wrench);
    if (!answer.torque.empty()) data.doubles(3, answer.torque);
    message.block(2, data);
  }
  return message.size();
}

}  // namespace palpate::fri
