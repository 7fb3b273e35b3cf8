// Validation shared by all constructors: one exception type, one form of message, "name = value: expected ...".
#pragma once
#include <cmath>
#include <cstddef>
#include <cstdio>
#include <stdexcept>
#include <string>

namespace palpate::check {

/// Throws std::invalid_argument("name = value: expected ...").
[[noreturn]] inline void fail(const std::string& name, double value, const std::string& expected) {
  char number[32];
  std::snprintf(number, sizeof number, "%.9g", value);
  throw std::invalid_argument(name + " = " + number + ": expected " + expected);
}

/// "kp[3] [N m/rad]": the name of one joint's entry in a message.
inline std::string entry(const std::string& name, std::size_t i, const std::string& unit) {
  return name + "[" + std::to_string(i) + "] [" + unit + "]";
}

inline int in_range(const std::string& name, int value, int lowest, int highest) {
  if (value < lowest || value > highest) fail(name, value, "an integer from " + std::to_string(lowest) + " to " + std::to_string(highest));
  return value;
}

inline double finite(const std::string& name, double value) {
  if (!std::isfinite(value)) fail(name, value, "a finite number");
  return value;
}

inline double positive(const std::string& name, double value) {
  if (!(std::isfinite(value) && value > 0.0)) fail(name, value, "a finite number > 0");
  return value;
}

inline double not_negative(const std::string& name, double value) {
  if (!(std::isfinite(value) && value >= 0.0)) fail(name, value, "a finite number >= 0");
  return value;
}

/// For limits, where infinity means "none".
inline double positive_or_infinite(const std::string& name, double value) {
  if (!(value > 0.0)) fail(name, value, "a number > 0, or infinity for no limit");
  return value;
}

/// True if the first n entries are finite. For use in step(): never throws.
template <class Array>
[[nodiscard]] inline bool all_finite(const Array& x, std::size_t n) noexcept {
  for (std::size_t i = 0; i < n; ++i)
    if (!std::isfinite(x[i])) return false;
  return true;
}

}  // namespace palpate::check
