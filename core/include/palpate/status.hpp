// Status: what may be believed of a sample or an estimate.
#pragma once
#include <cstdint>

namespace palpate {

/// Every sample and every estimate carries one. Only `ok` means "use this number".
/// Append only: the values are stored in logs.
enum class Status : std::uint8_t {
  ok = 0,          ///< trust the value and its standard deviation
  warming = 1,     ///< too little has been seen since start or reset
  held = 2,        ///< conditions for an estimate are not met now; the last good value is repeated
  gap = 3,         ///< samples are missing just before this one; the value is being rebuilt
  non_finite = 4,  ///< the input holds a NaN, an infinity or an absurd number; the sample was not used
  saturated = 5,   ///< the estimator or the actuator is at its bound; the truth may lie beyond
  singular = 6,    ///< the pose tells nothing about the quantity
  time_error = 7,  ///< time stood still or ran backwards; the sample was not used
};

/// Short lower-case name of a status, as printed and logged.
constexpr const char* name(Status s) noexcept {
  switch (s) {
    case Status::ok: return "ok";
    case Status::warming: return "warming";
    case Status::held: return "held";
    case Status::gap: return "gap";
    case Status::non_finite: return "non_finite";
    case Status::saturated: return "saturated";
    case Status::singular: return "singular";
    case Status::time_error: return "time_error";
  }
  return "unknown";
}

}  // namespace palpate
