// What all binding files share: numpy arrays in and out, and configurations as keyword-only Python classes.
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/shared_ptr.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <variant>
#include <vector>

#include "palpate/control/cartesian_impedance.hpp"
#include "palpate/control/cartesian_velocity.hpp"
#include "palpate/pipeline.hpp"
#include "palpate/velocity.hpp"

namespace nb = nanobind;

namespace palpate_py {

using Vector = nb::ndarray<const double, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Rows = nb::ndarray<const double, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Stack = nb::ndarray<const double, nb::ndim<3>, nb::c_contig, nb::device::cpu>;
using Flags = nb::ndarray<const bool, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Times = nb::ndarray<const std::int64_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

/// A new numpy array of the given shape, and the memory to fill.
template <class T>
struct Output {
  T* data;
  nb::object array;
  explicit Output(std::vector<std::size_t> shape) {
    std::size_t size = 1;
    for (std::size_t s : shape) size *= s;
    auto* memory = new T[size]();
    data = memory;
    nb::capsule owner(memory, [](void* p) noexcept { delete[] static_cast<T*>(p); });
    array = nb::cast(nb::ndarray<nb::numpy, T>(data, shape.size(), shape.data(), owner));
  }
};

inline void expect(bool ok, const std::string& what) {
  if (!ok) throw nb::value_error(what.c_str());
}
inline palpate::JointVector joints(const Vector& a, int n, const char* name) {
  expect(a.shape(0) == static_cast<std::size_t>(n), std::string(name) + ": expected " + std::to_string(n) + " numbers, got " + std::to_string(a.shape(0)));
  palpate::JointVector out{};
  for (std::size_t i = 0; i < static_cast<std::size_t>(n); ++i) out[i] = a.data()[i];
  return out;
}
inline palpate::JointVector row(const double* data, std::size_t i, int n) {
  palpate::JointVector out{};
  for (std::size_t j = 0; j < static_cast<std::size_t>(n); ++j) out[j] = data[i * static_cast<std::size_t>(n) + j];
  return out;
}
/// Runs `work` without the interpreter lock; no Python object may be touched in it.
template <class Work>
void unlocked(Work&& work) {
  nb::gil_scoped_release release;
  work();
}
inline nb::object array(const palpate::JointVector& v, int n) {
  Output<double> out({static_cast<std::size_t>(n)});
  for (std::size_t j = 0; j < static_cast<std::size_t>(n); ++j) out.data[j] = v[j];
  return out.array;
}

/// Names of an enumeration's values in Python, by value.
template <class E>
struct Names;
template <>
struct Names<palpate::Solver> {
  static constexpr std::array<const char*, 3> values{"euler", "rk4", "dormand_prince"};
};
template <>
struct Names<palpate::Axes> {
  static constexpr std::array<const char*, 2> values{"base", "tip"};
};
template <>
struct Names<palpate::Point> {
  static constexpr std::array<const char*, 2> values{"grasp", "tip"};
};
template <>
struct Names<palpate::Lag> {
  static constexpr std::array<const char*, 2> values{"exact", "published"};
};
template <>
struct Names<palpate::VelocityAxes> {
  static constexpr std::array<const char*, 2> values{"heading", "per_axis"};
};
template <>
struct Names<palpate::ContactSource> {
  static constexpr std::array<const char*, 2> values{"momentum", "model_residual"};
};

/// One field of a configuration: its name, where it is, what it means.
template <class C>
struct Option {
  const char* name;
  std::variant<double C::*, int C::*, bool C::*, palpate::Solver C::*, palpate::Axes C::*, palpate::Point C::*, palpate::ContactSource C::*,
               palpate::Lag C::*, palpate::VelocityAxes C::*, palpate::AbagParameters C::*, palpate::PostureConfig C::*, palpate::VelocityErrata C::*,
               palpate::SenderClockConfig C::*, std::array<double, 3> C::*, palpate::JointVector C::*>
      member;
  const char* doc;
};

/// Binds configuration C as a Python class with keyword-only arguments, read-only properties, options() and repr.
/// An unknown keyword is an error that lists the known ones; ranges are checked when a pipeline is built.
template <class C>
nb::class_<C> bind_config(nb::module_& m, const char* name, const char* doc, std::vector<Option<C>> options) {
  std::string text = std::string(doc) + "\n\nKeyword arguments:";
  const C defaults{};
  for (const auto& option : options) text += std::string("\n    ") + option.name + ": " + option.doc;
  auto* kept = new std::vector<Option<C>>(std::move(options));  // lives as long as the module
  auto* docs = new std::string(std::move(text));
  auto get = [](const C& c, const Option<C>& option) -> nb::object {
    return std::visit([&](auto member) -> nb::object {
      using Field = std::remove_cvref_t<decltype(c.*member)>;
      if constexpr (std::is_enum_v<Field>) {
        return nb::str(Names<Field>::values[static_cast<std::size_t>(c.*member)]);
      } else if constexpr (std::is_same_v<Field, std::array<double, 3>> || std::is_same_v<Field, palpate::JointVector>) {
        std::size_t count = (c.*member).size();  // of joints: up to the last that is not zero
        while (std::is_same_v<Field, palpate::JointVector> && count > 0 && (c.*member)[count - 1] == 0.0) --count;
        nb::list out;
        for (std::size_t i = 0; i < count; ++i) out.append((c.*member)[i]);
        return nb::tuple(out);
      } else {
        return nb::cast(c.*member);
      }
    }, option.member);
  };
  nb::class_<C> type(m, name, docs->c_str());
  type.def("__init__", [kept, name](C* self, const nb::kwargs& kwargs) {
    C c{};
    for (auto item : kwargs) {
      const std::string key = nb::cast<std::string>(nb::handle(item.first));
      const Option<C>* found = nullptr;
      std::string known;
      for (const auto& option : *kept) {
        if (key == option.name) found = &option;
        known += (known.empty() ? "" : ", ") + std::string(option.name);
      }
      expect(found != nullptr, std::string(name) + ": unknown option '" + key + "'; choose from " + known);
      const nb::handle value = item.second;
      std::visit([&](auto member) {
        using Field = std::remove_reference_t<decltype(c.*member)>;
        try {
          if constexpr (std::is_enum_v<Field>) {
            const std::string wanted = nb::cast<std::string>(value);
            std::string choices;
            bool known_value = false;
            for (std::size_t i = 0; i < Names<Field>::values.size(); ++i) {
              choices += (choices.empty() ? "" : ", ") + std::string(Names<Field>::values[i]);
              if (wanted != Names<Field>::values[i]) continue;
              c.*member = static_cast<Field>(i);
              known_value = true;
            }
            expect(known_value, std::string(name) + ": " + key + " '" + wanted + "'; choose from " + choices);
          } else if constexpr (std::is_same_v<Field, std::array<double, 3>> || std::is_same_v<Field, palpate::JointVector>) {
            const auto numbers = nb::cast<std::vector<double>>(value);
            constexpr bool per_joint = std::is_same_v<Field, palpate::JointVector>;
            expect(per_joint ? numbers.size() <= static_cast<std::size_t>(palpate::max_joints) : numbers.size() == 3,
                   std::string(name) + ": option '" + key + "': expected " + (per_joint ? "one number per joint" : "3 numbers") + ", got " +
                       std::to_string(numbers.size()));
            c.*member = {};
            for (std::size_t i = 0; i < numbers.size(); ++i) (c.*member)[i] = numbers[i];
          } else {
            c.*member = nb::cast<Field>(value);
          }
        } catch (const nb::cast_error&) {
          expect(false, std::string(name) + ": option '" + key + "' has the wrong type, got " + nb::cast<std::string>(nb::repr(value)));
        }
      }, found->member);
    }
    new (self) C(c);
  });
  for (const auto& option : *kept)
    type.def_prop_ro(option.name, [get, &option](const C& c) { return get(c, option); }, option.doc);
  type.def("options", [get, kept](const C& c) {
    nb::dict out;
    for (const auto& option : *kept) out[option.name] = get(c, option);
    return out;
  }, "All options as a dict; the class called with it gives an equal object.");
  type.def("__repr__", [get, kept, name](const C& c) {
    std::string out = std::string(name) + "(";
    bool first = true;
    for (const auto& option : *kept) {
      out += (first ? "" : ", ") + std::string(option.name) + "=" + nb::cast<std::string>(nb::repr(get(c, option)));
      first = false;
    }
    return out + ")";
  });
  (void)defaults;
  return type;
}

void bind_arm(nb::module_& m);
void bind_pipeline(nb::module_& m);
void bind_control(nb::module_& m);
void bind_phase(nb::module_& m);
void bind_cartesian(nb::module_& m);
void bind_velocity(nb::module_& m);
void bind_session(nb::module_& m);
void bind_teleop(nb::module_& m);
void bind_fri(nb::module_& m);

}  // namespace palpate_py
