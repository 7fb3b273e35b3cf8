// The contract between a session and an arm.
#pragma once
#include <cstdint>

#include "palpate/types.hpp"

namespace palpate {

/// What a period brought.
enum class Reading : std::uint8_t {
  sample,    ///< a new sample
  none,      ///< nothing in this period; the arm may go on with the last command for as long as the session is patient
  finished,  ///< nothing any more: the end of a recording
  fault,     ///< the arm cannot be read: the session stops it
};

/// An arm that is read and commanded once per period, from one thread.
///
/// The drives are off until enable() and after stop(). A sample is what was read, as it came; judging it is the pipeline's
/// job. Its effort is what was applied during the period that ended at it, in the unit of the arm's effort_gain. A driver
/// written for a hard loop allocates nothing and blocks no longer than its period in read() and write().
class Driver {
 public:
  virtual ~Driver() = default;
  [[nodiscard]] virtual int joints() const noexcept = 0;
  [[nodiscard]] virtual std::int64_t period_ns() const noexcept = 0;  ///< [ns], > 0
  /// True: read() itself waits for the period. False: the session's clock does, and read() returns at once.
  [[nodiscard]] virtual bool paced() const noexcept = 0;
  /// Drives on at the safe torque; may take its time. False: they refuse, see complaint().
  [[nodiscard]] virtual bool enable() noexcept = 0;
  [[nodiscard]] virtual Reading read(RawSample& out) noexcept = 0;
  /// torque: link-side motor torque [N m], gravity included, finite. sent: what really goes out [N m]. False: it could not be
  /// sent, see complaint().
  [[nodiscard]] virtual bool write(const JointVector& torque, JointVector& sent) noexcept = 0;
  /// The safe torque, then drives off: in any state, as often as one likes. Called from another thread only as the last
  /// resort, when the loop's own is stuck in a verb of this driver.
  virtual void stop() noexcept = 0;
  /// Why the last verb failed, one line.
  [[nodiscard]] virtual const char* complaint() const noexcept = 0;
};

}  // namespace palpate
