"""Checks a built wheel: its size, what is inside, and that it imports with numpy alone."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import venv
import zipfile
from pathlib import Path

MAX_BYTES = 3_000_000
NEEDED = ("palpate/__init__.py", "palpate/py.typed", "palpate/_core.pyi")
UNWANTED = ("__pycache__", "tests/", "core/")

# Modules only an extra brings must not be needed, nor loaded, by `import palpate`.
PROBE = """
import sys
before = set(sys.modules)
import palpate
files = {name: getattr(sys.modules[name], '__file__', None) or '' for name in set(sys.modules) - before}
roots = {name.split('.')[0] for name, file in files.items() if 'site-packages' in file}
extra = sorted(roots - {'palpate', 'numpy'})
sys.exit(f'import palpate also loaded {extra}' if extra else 0)
"""


def main(wheel: Path) -> int:
    size = wheel.stat().st_size
    names = zipfile.ZipFile(wheel).namelist()
    bad = [f"{wheel.name} lacks {n}" for n in NEEDED if n not in names]
    bad += [f"{wheel.name} holds {n}" for n in names if any(u in n for u in UNWANTED)]
    if not any(n.startswith("palpate/_core.") and n.endswith(".so") for n in names):
        bad.append(f"{wheel.name} lacks the compiled palpate/_core")
    if size > MAX_BYTES:
        bad.append(f"{wheel.name} has {size} bytes; the limit is {MAX_BYTES}")
    with tempfile.TemporaryDirectory() as folder:
        venv.create(folder, with_pip=True)
        python = str(Path(folder) / "bin" / "python")
        subprocess.run([python, "-m", "pip", "install", "--quiet", str(wheel)], check=True)
        probe = subprocess.run([python, "-I", "-c", PROBE], capture_output=True, text=True, cwd=folder)
        if probe.returncode != 0:
            bad.append(f"import palpate with numpy alone: {probe.stderr.strip()}")
    summary = f"{wheel.name}: {size / 1e3:.0f} kB, {len(names)} files, imports with numpy alone"
    print("\n".join(bad) if bad else summary)
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
