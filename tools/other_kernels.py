"""Runs a command with the numerical kernels of another CPU, with which OpenBLAS, numpy and numba round differently.

    python tools/other_kernels.py make test-local

On a CPU with AVX-512, the command uses the kernels for a CPU without AVX-512. On any other CPU, it uses the kernels for
a CPU without AVX.
"""

import os
import subprocess
import sys

import numpy as np

#: Prints numpy's CPU features and numba's CPU; each OpenBLAS prints "Core: ..." with OPENBLAS_VERBOSE=2.
REPORT = """
import numpy as np, scipy.linalg
from numba.core.registry import cpu_target
print("numpy:", *np.show_config(mode="dicts")["SIMD Extensions"].get("found", []))
print("numba:", cpu_target.target_context.codegen().magic_tuple()[1])
"""


def other_kernels() -> dict[str, str]:
    """Returns environment variables that select the kernels of another CPU."""
    found = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
    newest = [name for name in found if name == "X86_V4" or name.startswith("AVX512")]
    return {
        "OPENBLAS_CORETYPE": "Haswell" if newest else "Nehalem",
        "NPY_DISABLE_CPU_FEATURES": " ".join(newest or found),
        "NUMBA_CPU_NAME": "generic",  # part of the key of numba's cache
    }


def used_kernels(variables: dict[str, str]) -> list[str]:
    """Returns the lines that `REPORT` prints in a process with these variables."""
    environment = os.environ | variables | {"OPENBLAS_VERBOSE": "2"}
    done = subprocess.run(
        [sys.executable, "-c", REPORT],
        env=environment,
        check=True,
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    return sorted(set(done.stdout.splitlines()))


def main() -> None:
    """Checks that the variables take effect, then runs the command."""
    variables = other_kernels()
    used = used_kernels(variables)
    remaining = next(line for line in used if line.startswith("numpy:")).split()
    disabled = variables["NPY_DISABLE_CPU_FEATURES"].split()
    expected = {f"Core: {variables['OPENBLAS_CORETYPE']}", f"numba: {variables['NUMBA_CPU_NAME']}"}
    if not expected <= set(used) or set(disabled) & set(remaining):
        sys.exit(f"other_kernels.py: the variables {variables} have no effect; in use: {'; '.join(used)}")
    print("kernels:", "; ".join(used), flush=True)
    os.execvpe(sys.argv[1], sys.argv[1:], os.environ | variables)


if __name__ == "__main__":
    main()
