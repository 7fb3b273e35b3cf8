// Estimates of many samples as numpy arrays, one row per sample.
#pragma once
#include "common.hpp"

namespace palpate_py {

using palpate::Contact;
using palpate::PipelineConfig;
using palpate::Touch;
using palpate::Wrench;

/// One row per sample of a run's wrenches.
struct WrenchRows {
  Output<double> force, force_std, moment, moment_std, covariance, conditioning, load_mass;
  Output<bool> singular;
  Output<std::uint8_t> status;
  explicit WrenchRows(std::size_t N)
      : force({N, 3}), force_std({N, 3}), moment({N, 3}), moment_std({N, 3}), covariance({N, 6, 6}), conditioning({N}), load_mass({N}), singular({N, 6}), status({N}) {}
  void fill(std::size_t i, const Wrench& w) noexcept {
    for (std::size_t k = 0; k < 3; ++k) {
      force.data[3 * i + k] = w.force[k];
      force_std.data[3 * i + k] = w.force_std[k];
      moment.data[3 * i + k] = w.moment[k];
      moment_std.data[3 * i + k] = w.moment_std[k];
    }
    for (std::size_t k = 0; k < 36; ++k) covariance.data[36 * i + k] = w.covariance[k];
    for (std::size_t k = 0; k < 6; ++k) singular.data[6 * i + k] = w.singular[k];
    conditioning.data[i] = w.conditioning;
    load_mass.data[i] = w.load_mass;
    status.data[i] = static_cast<std::uint8_t>(w.status);
  }
  nb::dict dict() const {
    nb::dict d;
    d["force"] = force.array;
    d["force_std"] = force_std.array;
    d["moment"] = moment.array;
    d["moment_std"] = moment_std.array;
    d["covariance"] = covariance.array;
    d["singular"] = singular.array;
    d["conditioning"] = conditioning.array;
    d["load_mass"] = load_mass.array;
    d["status"] = status.array;
    return d;
  }
};

/// And of its contacts.
struct ContactRows {
  std::size_t n;
  Output<double> torque, std, level;
  Output<bool> active, tip;
  Output<std::int32_t> link, farthest;
  Output<std::uint32_t> count;
  Output<std::int64_t> onset, alarm, release;
  Output<std::uint8_t> status;
  ContactRows(std::size_t N, std::size_t joints)
      : n(joints), torque({N, n}), std({N, n}), level({N, n}), active({N}), tip({N}), link({N}), farthest({N}), count({N}), onset({N}), alarm({N}), release({N}), status({N}) {}
  void fill(std::size_t i, const Contact& c) noexcept {
    for (std::size_t j = 0; j < n; ++j) {
      torque.data[i * n + j] = c.torque[j];
      std.data[i * n + j] = c.std[j];
      level.data[i * n + j] = c.level[j];
    }
    active.data[i] = c.active;
    tip.data[i] = c.tip;
    link.data[i] = c.link;
    farthest.data[i] = c.farthest;
    count.data[i] = c.count;
    onset.data[i] = c.onset_time_ns;
    alarm.data[i] = c.alarm_time_ns;
    release.data[i] = c.release_time_ns;
    status.data[i] = static_cast<std::uint8_t>(c.status);
  }
  nb::dict dict() const {
    nb::dict d;
    d["active"] = active.array;
    d["link"] = link.array;
    d["farthest"] = farthest.array;
    d["tip"] = tip.array;
    d["torque"] = torque.array;
    d["std"] = std.array;
    d["level"] = level.array;
    d["count"] = count.array;
    d["onset_time_ns"] = onset.array;
    d["alarm_time_ns"] = alarm.array;
    d["release_time_ns"] = release.array;
    d["status"] = status.array;
    return d;
  }
};

/// All of Touch but its time; wrench and contact where the pipeline makes them.
struct TouchRows {
  std::size_t n;
  Output<double> q, dq, torque, torque_std, mass, mass_std, moment, moment_std;
  Output<std::uint8_t> status, external_status, payload_status;
  Output<std::uint32_t> changes;
  Output<std::int64_t> change_time;
  std::optional<WrenchRows> wrench;
  std::optional<ContactRows> contact;
  TouchRows(std::size_t N, std::size_t joints, const PipelineConfig& config)
      : n(joints), q({N, n}), dq({N, n}), torque({N, n}), torque_std({N, n}), mass({N}), mass_std({N}), moment({N, 3}), moment_std({N, 3}), status({N}),
        external_status({N}), payload_status({N}), changes({N}), change_time({N}) {
    if (config.wrench) wrench.emplace(N);
    if (config.contact) contact.emplace(N, n);
  }
  void fill(std::size_t i, const Touch& t) noexcept {
    for (std::size_t j = 0; j < n; ++j) {
      q.data[i * n + j] = t.q[j];
      dq.data[i * n + j] = t.dq[j];
      torque.data[i * n + j] = t.external.torque[j];
      torque_std.data[i * n + j] = t.external.std[j];
    }
    for (std::size_t k = 0; k < 3; ++k) {
      moment.data[3 * i + k] = t.payload.first_moment[k];
      moment_std.data[3 * i + k] = t.payload.first_moment_std[k];
    }
    mass.data[i] = t.payload.mass;
    mass_std.data[i] = t.payload.mass_std;
    status.data[i] = static_cast<std::uint8_t>(t.status);
    external_status.data[i] = static_cast<std::uint8_t>(t.external.status);
    payload_status.data[i] = static_cast<std::uint8_t>(t.payload.status);
    changes.data[i] = t.payload.changes;
    change_time.data[i] = t.payload.change_time_ns;
    if (wrench) wrench->fill(i, t.wrench);
    if (contact) contact->fill(i, t.contact);
  }
  nb::dict dict() const {
    nb::dict d;
    d["q"] = q.array;
    d["dq"] = dq.array;
    d["status"] = status.array;
    d["torque"] = torque.array;
    d["torque_std"] = torque_std.array;
    d["external_status"] = external_status.array;
    d["mass"] = mass.array;
    d["mass_std"] = mass_std.array;
    d["first_moment"] = moment.array;
    d["first_moment_std"] = moment_std.array;
    d["payload_status"] = payload_status.array;
    d["changes"] = changes.array;
    d["change_time_ns"] = change_time.array;
    if (wrench) d["wrench"] = wrench->dict();
    if (contact) d["contact"] = contact->dict();
    return d;
  }
};

}  // namespace palpate_py
