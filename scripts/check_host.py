"""Can palpate be built here? make runs this with the python3 it found, so it is written for any Python."""

import os
import shutil
import subprocess
import sys
import sysconfig


def problems():
    """Sentences, each naming what is missing and what to do."""
    if sys.version_info < (3, 11):
        found = "%d.%d (%s)" % (sys.version_info[0], sys.version_info[1], sys.executable)
        return ["needs Python 3.11 or newer; found " + found + ". To choose another: make PYTHON=python3.12"]
    found = []
    try:
        import ensurepip  # noqa: F401
        import venv  # noqa: F401
    except ImportError:
        found.append("this Python lacks venv. On Debian or Ubuntu: apt-get install python3-venv")
    header = os.path.join(sysconfig.get_paths()["include"], "Python.h")
    if not os.path.exists(header):
        found.append("Python.h is missing (" + header + "). On Debian or Ubuntu: apt-get install python3-dev")
    compiler = os.environ.get("CXX") or next(filter(shutil.which, ("c++", "g++", "clang++")), None)
    if compiler is None:
        found.append("no C++ compiler found. On Debian or Ubuntu: apt-get install g++")
    else:
        probe = subprocess.run(
            compiler.split() + ["-std=c++20", "-fsyntax-only", "-x", "c++", "-"],
            input=b"#include <concepts>\ntemplate <std::floating_point T> struct Probe { T value; };\n",
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        if probe.returncode != 0:
            first = (probe.stdout.decode(errors="replace").strip().splitlines() or ["no message"])[0]
            found.append(compiler + " does not compile C++20 (GCC 11 or Clang 14 do): " + first)
    return found


if __name__ == "__main__":
    sys.exit("\n".join("palpate: " + line for line in problems()) or 0)
