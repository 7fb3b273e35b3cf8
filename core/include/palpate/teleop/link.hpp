// What one side knows of the other: the newest message, how long ago it came, and how far the two are coupled.
#pragma once
#include <algorithm>
#include <cmath>

#include "palpate/check.hpp"
#include "palpate/teleop/message.hpp"

namespace palpate::teleop {

struct LinkConfig {
  double timeout = 0.25;  ///< without anything new for so long the link is dead [s], > 0
  double ramp = 1.0;      ///< from nothing to fully coupled [s], > 0
};

/// Keeps the newest message by its number, whatever order they come in, and the gain of the coupling: 0 apart, 1 coupled.
///
/// The gain falls to 0 at once where both sides hold anyway (motion), and rises by a smooth step over `ramp`: what returns, returns slowly.
class Link {
 public:
  explicit Link(const LinkConfig& config = {}) : c_(config) {
    check::positive("LinkConfig timeout [s]", c_.timeout);
    check::positive("LinkConfig ramp [s]", c_.ramp);
  }

  /// True if it is newer than everything before. An older session, an older number and broken numbers are left.
  bool receive(const Message& m, std::size_t n) noexcept {
    const bool sound = m.sequence > 0 && check::all_finite(m.position, n) && check::all_finite(m.velocity, n) && check::all_finite(m.force, n) &&
                       std::isfinite(m.energy) && std::isfinite(m.booked) && std::isfinite(m.level);
    if (!sound || m.session < newest_.session || (m.session == newest_.session && m.sequence <= newest_.sequence)) return false;
    restarted_ = restarted_ || m.session != newest_.session;
    newest_ = m;
    fresh_ = true;
    return true;
  }

  /// One period of dt [s]; `closed`: the own clutch.
  void step(double dt, bool closed) noexcept {
    silence_ = fresh_ ? 0.0 : silence_ + dt;
    const bool was = alive_;
    alive_ = newest_.sequence > 0 && silence_ < c_.timeout;
    returned_ = alive_ && (!was || restarted_);
    died_ = was && !alive_;
    began_ = restarted_;
    restarted_ = false;
    fresh_ = false;
    closed_ = closed && newest_.engaged;
    if (!alive_ || !closed_ || returned_) phase_ = 0.0;
    else phase_ = std::min(1.0, phase_ + dt / c_.ramp);
  }

  const Message& newest() const noexcept { return newest_; }
  bool alive() const noexcept { return alive_; }
  bool returned() const noexcept { return returned_; }  ///< just now
  bool began() const noexcept { return began_; }        ///< just now, a session: its sums count from what it says first
  bool died() const noexcept { return died_; }          ///< just now
  bool closed() const noexcept { return closed_; }      ///< both clutches
  double silence() const noexcept { return silence_; }  ///< since something new came [s]
  /// 0 apart, 1 coupled; smooth.
  double gain() const noexcept { return phase_ * phase_ * (3.0 - 2.0 * phase_); }
  std::uint16_t events() const noexcept {
    return static_cast<std::uint16_t>((alive_ ? 0 : event_link) | (alive_ && !closed_ ? event_clutch : 0) | (alive_ && closed_ && phase_ < 1.0 ? event_engaging : 0));
  }

 private:
  LinkConfig c_;
  Message newest_{};
  double silence_ = 0.0, phase_ = 0.0;
  bool alive_ = false, fresh_ = false, returned_ = false, died_ = false, closed_ = false, restarted_ = false, began_ = false;
};

}  // namespace palpate::teleop
