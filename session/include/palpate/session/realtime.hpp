// What the operating system grants a loop's thread: priority, memory that is not paged out, a processor; and why not.
#pragma once
#include <pthread.h>
#include <sched.h>
#include <sys/mman.h>

#include <cerrno>
#include <cstring>
#include <string>

namespace palpate {

struct RealtimeConfig {
  int priority = 80;        ///< of SCHED_FIFO, 1 to 99; 0: not asked for
  bool lock_memory = true;  ///< keep what the process holds now in memory (mlockall)
  int processor = -1;       ///< run on this one alone; -1: on any
};

/// What was granted. What was not asked for is false and has no complaint.
struct RealtimeReport {
  bool fifo = false;      ///< SCHED_FIFO
  bool locked = false;    ///< memory
  bool pinned = false;    ///< to one processor
  std::string complaint;  ///< what was refused, why, and what allows it; empty: nothing
};

/// Asks for all of it for the calling thread; goes on without what is refused, and says so.
///
/// Memory is locked as it is now (MCL_CURRENT), not what comes later: a limit on locked memory would otherwise fail
/// allocations of the rest of the program. A loop that allocates nothing has all it needs by then.
inline RealtimeReport enter_realtime(const RealtimeConfig& config) {
  RealtimeReport report;
  const auto refused = [&report](const char* what, int error, const char* remedy) {
    report.complaint += (report.complaint.empty() ? "" : "; ") + std::string(what) + ": " + std::strerror(error) + " (" + remedy + ")";
  };
  if (config.priority > 0) {
    sched_param parameter{};
    parameter.sched_priority = config.priority;
    const int error = pthread_setschedparam(pthread_self(), SCHED_FIFO, &parameter);
    report.fifo = error == 0;
    if (error != 0) refused("SCHED_FIFO", error, "rtprio in /etc/security/limits.conf, or root");
  }
  if (config.lock_memory) {
    report.locked = mlockall(MCL_CURRENT) == 0;
    if (!report.locked) refused("mlockall", errno, "memlock in /etc/security/limits.conf, or root");
  }
  if (config.processor >= 0) {
    cpu_set_t set;
    CPU_ZERO(&set);
    int error = EINVAL;
    if (config.processor < CPU_SETSIZE) {
      CPU_SET(static_cast<unsigned>(config.processor), &set);
      error = pthread_setaffinity_np(pthread_self(), sizeof set, &set);
    }
    report.pinned = error == 0;
    if (error != 0) refused("processor", error, "is there one of that number that this program may use?");
  }
  return report;
}

}  // namespace palpate
