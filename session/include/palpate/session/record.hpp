// Record: everything about one tick, and its short form for the buffers of a session.
#pragma once
#include <cstddef>
#include <cstdint>
#include <cstring>

#include "palpate/types.hpp"

namespace palpate {

enum class Mode : std::uint8_t {
  watching = 0,  ///< the arm is read, its drives are off
  enabled = 1,   ///< the controller moves it
  stopped = 2,   ///< over, on request or at the end of a recording
  fault = 3,     ///< over, because of what ControlLoop::fault() says
};

/// Everything about one tick that brought a sample.
struct Record {
  std::uint64_t tick = 0;         ///< number of the tick, from 0; those lost count too
  Mode mode = Mode::watching;     ///< during the tick
  RawSample raw{};
  Touch touch{};
  Setpoint setpoint{};            ///< read only if commanded
  JointVector wanted{};           ///< torque before the safety limiter [N m]; read only if commanded
  JointVector sent{};             ///< torque that went out [N m]; read only if commanded
  Status control = Status::held;  ///< of the command: ok, saturated, ...; held: there is none
  std::uint8_t limited = 0;       ///< Limited bits
  bool commanded = false;         ///< a command was sent for this sample
  double tare = 0.0;              ///< mass that is called zero [kg]
  double tare_std = 0.0;          ///< its standard deviation [kg]
  std::uint64_t tares = 0;        ///< number of the request for that tare, see Request::tare; 0: none yet
  std::int64_t late_ns = 0;       ///< by how much the tick began late [ns]
  std::int64_t read_ns = 0, step_ns = 0, write_ns = 0;  ///< what it spent in the driver, in estimating and controlling, in the driver again [ns]
};

/// A Record without what nobody asked for: joints beyond the arm's, wrench and contact where the pipeline makes none, and what is
/// not read unless its flag is set. A third of the size and less: what a tick writes is cold memory, which costs it time.
class RecordFormat {
 public:
  /// wrench, contact: whether records have them.
  RecordFormat(int n, bool wrench, bool contact) noexcept : joints_(static_cast<std::size_t>(n) * sizeof(double)), wrench_(wrench), contact_(contact) {
    Record whole;
    whole.raw.has_velocity = whole.raw.has_model_torque = whole.commanded = true;
    walk(whole, [this](const void*, std::size_t size) { bytes_ += size; });
  }
  /// Of the longest short form.
  [[nodiscard]] std::size_t bytes() const noexcept { return bytes_; }

  /// Returns the bytes written.
  std::size_t pack(const Record& r, std::byte* out) const noexcept {
    const std::byte* const begin = out;
    walk(r, [&out](const void* from, std::size_t size) {
      std::memcpy(out, from, size);
      out += size;
    });
    return static_cast<std::size_t>(out - begin);
  }
  /// What the short form leaves out is as in a new Record.
  void unpack(const std::byte* in, Record& out) const noexcept {
    out = {};
    walk(out, [&in](void* to, std::size_t size) {
      std::memcpy(to, in, size);
      in += size;
    });
  }

 private:
  /// Every field that belongs to the short form, flags before what they are about.
  template <class R, class Visit>
  void walk(R& r, Visit&& visit) const noexcept {
    const auto all = [&visit](auto&... fields) { (visit(&fields, sizeof fields), ...); };
    const auto joints = [&visit, this](auto&... vectors) { (visit(vectors.data(), joints_), ...); };
    all(r.tick, r.mode, r.control, r.limited, r.commanded, r.tare, r.tare_std, r.tares, r.late_ns, r.read_ns, r.step_ns, r.write_ns);
    all(r.raw.time_ns, r.raw.has_velocity, r.raw.has_model_torque);
    joints(r.raw.position, r.raw.effort);
    if (r.raw.has_velocity) joints(r.raw.velocity);
    if (r.raw.has_model_torque) joints(r.raw.model_torque);
    auto& touch = r.touch;
    all(touch.time_ns, touch.status, touch.external.status, touch.payload);
    joints(touch.q, touch.dq, touch.external.torque, touch.external.std, touch.external.noise);
    if (wrench_) all(touch.wrench);
    else all(touch.wrench.status);
    auto& contact = touch.contact;
    all(contact.status);
    if (contact_) {
      all(contact.active, contact.link, contact.farthest, contact.tip, contact.count, contact.onset_time_ns, contact.alarm_time_ns, contact.release_time_ns);
      joints(contact.torque, contact.std, contact.level);
    }
    if (r.commanded) joints(r.setpoint.q, r.setpoint.dq, r.setpoint.ddq, r.wanted, r.sent);
  }

  std::size_t joints_;  // of a vector [bytes]
  bool wrench_, contact_;
  std::size_t bytes_ = 0;
};

}  // namespace palpate
