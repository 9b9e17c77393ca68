"""Run a command with the kernels of another CPU: OpenBLAS, numpy and numba round differently on each kind.

    python tools/other_kernels.py make test-fast

A CPU with AVX-512 takes the code of one without it, any other CPU the code of one without AVX.
"""

import os
import subprocess
import sys

import numpy as np

#: Prints what is used: numpy's features, numba's CPU, and each OpenBLAS ("Core: ..." with OPENBLAS_VERBOSE=2).
REPORT = """
import numpy as np, scipy.linalg
from numba.core.registry import cpu_target
print("numpy:", *np.show_config(mode="dicts")["SIMD Extensions"].get("found", []))
print("numba:", cpu_target.target_context.codegen().magic_tuple()[1])
"""


def other_kernels() -> dict[str, str]:
    """Environment variables that choose them."""
    found = np.show_config(mode="dicts")["SIMD Extensions"].get("found", [])
    newest = [name for name in found if name == "X86_V4" or name.startswith("AVX512")]
    return {
        "OPENBLAS_CORETYPE": "Haswell" if newest else "Nehalem",
        "NPY_DISABLE_CPU_FEATURES": " ".join(newest or found),
        "NUMBA_CPU_NAME": "generic",  # numba caches by this name, too
    }


def used_kernels(variables: dict[str, str]) -> list[str]:
    """Lines of `REPORT` in a process with these variables."""
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
    """Check that the variables act, then become the command."""
    variables = other_kernels()
    used = used_kernels(variables)
    left = next(line for line in used if line.startswith("numpy:")).split()
    disabled = variables["NPY_DISABLE_CPU_FEATURES"].split()
    wanted = {f"Core: {variables['OPENBLAS_CORETYPE']}", f"numba: {variables['NUMBA_CPU_NAME']}"}
    if not wanted <= set(used) or set(disabled) & set(left):
        sys.exit(f"other_kernels.py: the variables {variables} do not act; used are: {'; '.join(used)}")
    print("kernels:", "; ".join(used), flush=True)
    os.execvpe(sys.argv[1], sys.argv[1:], os.environ | variables)


if __name__ == "__main__":
    main()
