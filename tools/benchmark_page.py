"""Writes the measured results into docs/benchmark_tables.md: runs its commands and replaces their outputs.

DVRK_DRAKE_SHARED=FOLDER python tools/benchmark_page.py             # all commands, for hours
DVRK_DRAKE_SHARED=FOLDER python tools/benchmark_page.py payload     # commands that contain a word
python tools/benchmark_page.py --list

A command is in a comment of the page, and its output follows until the comment `end`:

    <!-- run: python benchmarks/interval_coverage.py -->
    <!-- end -->

The output contains commit, date, processor, versions and duration. FOLDER/data contains the recordings. If a command
fails, its old output remains and the exit code is 1.
"""

import argparse
import os
import platform
import re
import subprocess
import sys
import time
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "benchmark_tables.md"
BLOCK = re.compile(r"<!-- run: (?P<command>.+?) -->\n(?P<output>.*?)<!-- end -->\n", re.DOTALL)


def processor() -> str:
    """Returns the name of the processor."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()


def commit() -> str:
    """Returns the commit of the repository, with "-dirty" if a file other than the page was changed."""
    git = ["git", "-C", str(ROOT)]
    name = subprocess.check_output([*git, "rev-parse", "--short=8", "HEAD"], text=True).strip()
    status = [*git, "status", "--porcelain", "-uno", ".", ":!docs/benchmark_tables.md"]
    changes = subprocess.check_output(status, text=True)
    return f"{name}-dirty" if changes else name


def conditions(seconds: float) -> str:
    """Returns a line on commit, date, computer, versions and duration."""
    versions = ", ".join(f"{name} {version(name)}" for name in ("drake", "numpy", "scipy"))
    return (
        f"*Commit {commit()}, {datetime.now(UTC):%Y-%m-%d}, {os.cpu_count()} cores of {processor()}, "
        f"Python {platform.python_version()}, {versions}; {seconds:.0f} s.*"
    )


def without_paths(text: str) -> str:
    """Returns an output without paths of this computer, and without blanks at the ends of lines."""
    text = text.replace(f"{ROOT}/", "").replace(os.environ.get("DVRK_DRAKE_SHARED") or "?", "$DVRK_DRAKE_SHARED")
    text = re.sub(r"/tmp/tmp\.\w+", "$T", text)
    return "\n".join(line.rstrip() for line in text.splitlines()).strip("\n")


def measured(command: str) -> str | None:
    """Runs a command in the repository and returns the text for the page, or None if the command fails."""
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "COLUMNS": "120", "PYTHONWARNINGS": "ignore"}
    start = time.perf_counter()
    result = subprocess.run(
        ["bash", "-c", command], cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True, check=False
    )
    if result.returncode:
        return None
    output = without_paths(result.stdout)
    # Markdown tables are shown as tables, other outputs as text.
    if not re.search(r"^\|( ?:?-+:? ?\|)+$", output, re.MULTILINE):
        output = f"```text\n{output}\n```"
    shown = command.replace(" && ", " && \\\n    ")
    return f"\n    {shown}\n\n{output}\n\n{conditions(time.perf_counter() - start)}\n\n"


def main() -> int:
    """Runs the selected commands."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("words", nargs="*", help="run only commands that contain one of these words")
    parser.add_argument("--list", action="store_true", help="print the commands, without running them")
    options = parser.parse_args()
    commands = [found["command"] for found in BLOCK.finditer(PAGE.read_text())]
    selected = [each for each in commands if not options.words or any(word in each for word in options.words)]
    failed = []
    for number, command in enumerate(selected, start=1):
        print(f"{number} of {len(selected)}: {command}", flush=True)
        if options.list:
            continue
        output = measured(command)
        if output is None:
            failed.append(command)
            continue
        # The page is read again, since a benchmark takes minutes and the page may be edited meanwhile.
        text, old = (
            PAGE.read_text(),
            re.compile(rf"(<!-- run: {re.escape(command)} -->\n).*?(<!-- end -->\n)", re.DOTALL),
        )
        PAGE.write_text(old.sub(lambda found, new=output: found[1] + new + found[2], text))
    for command in failed:
        print(f"failed: {command}", file=sys.stderr)
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
