// Core objects as Python holds them: with the number of joints at hand for conversions.
#pragma once
#include "common.hpp"

#include "palpate/control/feedforward_pd.hpp"
#include "palpate/control/limiter.hpp"

namespace palpate_py {

struct PyPipeline {
  PyPipeline(std::shared_ptr<const palpate::Arm> arm, const nb::object& observer, const nb::object& payload, const palpate::ConditionerConfig& conditioner,
             const palpate::LoadConfig& load, const nb::object& wrench, const nb::object& contact);
  palpate::Pipeline pipeline;
  int n;
};

struct PyTouch {
  palpate::Touch touch;
  int n;
};

struct PyController {
  std::shared_ptr<const palpate::Arm> arm;
  palpate::FeedforwardPd pd;
};

struct PyLimiter {
  palpate::SafetyLimiter limiter;
  int n;
};

}  // namespace palpate_py
