"""Mutation testing: changes one operator, constant or statement at a time and lists the changes that no test detects.

Each mutant is tested in a fork of a process that has imported Drake and numpy. Tests that recently detected a mutant
run first, then the fastest tests. Tests marked slow do not run. The script refuses modules that numba compiles, since
numba would use the unchanged functions from its cache.
"""

import ast
import importlib.util
import multiprocessing
import os
import signal
import sys
import time
from argparse import ArgumentParser
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import redirect_stderr, redirect_stdout, suppress
from functools import partial
from pathlib import Path
from types import CodeType
from typing import Any, NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[1]
PROCESSES = multiprocessing.get_context("fork")
_SWAPS = (
    "Lt:LtE,GtE LtE:Lt,Gt Gt:GtE,LtE GtE:Gt,Lt Eq:NotEq NotEq:Eq Is:IsNot IsNot:Is In:NotIn NotIn:In And:Or Or:And "
    "Add:Sub Sub:Add Mult:Div Div:Mult Pow:Mult BitOr:BitAnd BitAnd:BitOr LShift:RShift RShift:LShift"
)
#: Replacements of each operator.
OPERATORS = {
    getattr(ast, old): [getattr(ast, name) for name in new.split(",")]
    for old, new in (swap.split(":") for swap in _SWAPS.split())
}
#: Replacement of each function.
FUNCTIONS = {"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum", "any": "all", "all": "any"}
#: Functions that are replaced by their first argument, and methods that are replaced by their object.
IDENTITIES = {"clip", "abs", "copy", "round"}


class Mutant(NamedTuple):
    """Changed module: file, line and text of the change, and compiled module."""

    path: Path
    line: int
    text: str
    code: CodeType


def replacements(node: Any) -> Iterator[Any]:
    """Yields the replacements of `node`."""
    match node:
        case ast.Constant(bool()):
            yield ast.Constant(not node.value)
        case ast.Constant(int()):
            yield from (ast.Constant(node.value + 1), ast.Constant(node.value - 1))
        case ast.Constant(float()):
            yield from (ast.Constant(2 * node.value or 1.0), ast.Constant(node.value / 2 or -1.0))
        case ast.Compare(left, operators, right):
            for i, operator in enumerate(operators):
                for other in OPERATORS[type(operator)]:
                    yield ast.Compare(left, [*operators[:i], other(), *operators[i + 1 :]], right)
        case ast.BoolOp(operator, values):
            yield ast.BoolOp(OPERATORS[type(operator)][0](), values)
            for i in range(len(values)):
                rest = values[:i] + values[i + 1 :]
                yield ast.BoolOp(operator, rest) if len(rest) > 1 else rest[0]
        case ast.BinOp(left, operator, right) if type(operator) in OPERATORS:
            yield ast.BinOp(left, OPERATORS[type(operator)][0](), right)
        case ast.AugAssign(target, operator, value) if type(operator) in OPERATORS:
            yield from (ast.AugAssign(target, OPERATORS[type(operator)][0](), value), ast.Pass())
        case ast.UnaryOp(ast.Not() | ast.USub() | ast.Invert(), operand):
            yield operand
        case ast.If(test, body, orelse) if not isinstance(test, ast.Compare | ast.BoolOp | ast.UnaryOp):
            yield ast.If(ast.UnaryOp(ast.Not(), test), body, orelse)
        case ast.IfExp(_, body, orelse):
            yield from (body, orelse)
        case ast.Call(ast.Name(name), arguments, keywords) if name in FUNCTIONS:
            yield ast.Call(ast.Name(FUNCTIONS[name], ast.Load()), arguments, keywords)
        case ast.Call(ast.Attribute(value, name), arguments, keywords) if name in FUNCTIONS:
            yield ast.Call(ast.Attribute(value, FUNCTIONS[name], ast.Load()), arguments, keywords)
        case ast.Call(ast.Name(name) | ast.Attribute(_, name), arguments) if name in IDENTITIES:
            yield arguments[0] if arguments else node.func.value
        case ast.Expr(ast.Call()) | ast.Assign() | ast.Return() | ast.Raise() | ast.Continue() | ast.Break():
            yield ast.Pass()


def mutants(path: Path) -> Iterator[Mutant]:
    """Yields all mutants of a module. Annotations, docstrings, messages and `if TYPE_CHECKING` are not changed."""
    tree = ast.parse(path.read_text())

    def visit(node: Any) -> Iterator[Mutant]:
        for field, value in ast.iter_fields(node):
            for i, child in enumerate(value if isinstance(value, list) else [value]):
                if field in ("annotation", "returns", "decorator_list") or not isinstance(child, ast.AST):
                    continue
                if isinstance(child, ast.JoinedStr) or "TYPE_CHECKING" in ast.dump(getattr(child, "test", ast.Pass())):
                    continue
                for other in replacements(child):
                    was, now = (ast.unparse(part).partition("\n")[0] for part in (child, other))
                    new = ast.fix_missing_locations(ast.copy_location(other, child))
                    setattr(node, field, [*value[:i], new, *value[i + 1 :]] if isinstance(value, list) else new)
                    yield Mutant(path, child.lineno, f"{was}  ->  {now}", compile(tree, path, "exec"))
                    setattr(node, field, value)
                yield from visit(child)

    return visit(tree)


class _Tests:
    """Runs tests in a forked process that imports a mutant instead of the module.

    The object is also a pytest plugin. `shared` contains the sort key of each test. The value of its key "" is the CPU
    time of the process and the names of the imported modules.
    """

    def __init__(self, tests: list[str], shared: Any, limit: float, mutant: Mutant | None = None) -> None:
        self.tests, self.shared, self.limit, self.mutant = tests, shared, limit, mutant
        self.module = mutant and ".".join(mutant.path.relative_to(ROOT).with_suffix("").parts)

    def exit_code(self) -> int | None:
        """Returns the exit code of pytest. The process is killed after `limit` seconds of CPU time."""
        process = PROCESSES.Process(target=self._run)
        process.start()
        process.join()
        return process.exitcode

    def _run(self) -> None:
        sys.meta_path.insert(0, self)
        signal.setitimer(signal.ITIMER_PROF, self.limit)
        with open(os.devnull, "w") as null, redirect_stdout(null), redirect_stderr(null):
            code = pytest.main(["-x", "-m", "not slow", "-p", "no:cacheprovider", *self.tests], plugins=[self])
        self.shared.setdefault("", (time.process_time(), list(sys.modules)))
        os._exit(code)

    def find_spec(self, name: str, path: Any, target: Any = None) -> Any:
        return importlib.util.spec_from_loader(name, self) if name == self.module else None

    def create_module(self, spec: Any) -> None: ...

    def exec_module(self, module: Any) -> None:
        exec(self.mutant.code, module.__dict__)

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        keys = self.shared.copy()
        items.sort(key=lambda item: keys.get(item.nodeid, 0.0))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.shared[report.nodeid] = -time.monotonic()
        elif report.when == "call":
            self.shared.setdefault(report.nodeid, report.duration)


def main() -> None:
    """Prints the surviving mutants and their number per module."""
    parser = ArgumentParser(description=__doc__)
    parser.add_argument("path", type=Path, help="module or folder, e.g. dvrk_drake/systems/guard")
    parser.add_argument("--tests", nargs="+", help="tests to run; default: the folder of the same name in tests/")
    parser.add_argument("--every", type=int, default=1, help="test only every n-th mutant; default: %(default)s")
    parser.add_argument(
        "--jobs",
        type=int,
        default=os.cpu_count() or 1,
        help="number of mutants tested in parallel; default: %(default)s",
    )
    options = parser.parse_args()
    path = options.path.resolve()
    folder = (path if path.is_dir() else path.parent).relative_to(ROOT / "dvrk_drake")
    files = sorted(path.rglob("*.py")) if path.is_dir() else [path]
    if compiled := [file.name for file in files if "import numba" in file.read_text()]:
        parser.error(f"numba compiles {', '.join(compiled)}. Give modules that numba does not compile.")
    tests = partial(_Tests, options.tests or [str(ROOT / "tests" / folder)], shared := PROCESSES.Manager().dict())
    if tests(limit=1e6).exit_code():
        parser.error("the tests fail without a mutant, or there are no tests. Select other tests with --tests.")
    needed, modules = shared.pop("")
    own = {file.stem for file in (ROOT / "tests").rglob("*.py")}
    for name in modules:
        if not name.startswith("dvrk_drake") and name.rpartition(".")[2] not in own:
            with suppress(Exception):
                importlib.import_module(name)
    todo = [mutant for file in files for mutant in mutants(file)][:: options.every]
    survived = Counter[Path]()
    with ThreadPoolExecutor(options.jobs) as pool:
        codes = pool.map(lambda mutant: tests(3 * needed + 10, mutant).exit_code(), todo)
        for mutant, code in zip(todo, codes, strict=True):
            if code == pytest.ExitCode.OK:
                survived[mutant.path] += 1
                print(f"{mutant.path.relative_to(ROOT)}:{mutant.line}: {mutant.text}", flush=True)
    for file, made in Counter(mutant.path for mutant in todo).items():
        print(f"{file.relative_to(ROOT)}: {made} mutants, {survived[file]} survive")
    print(f"{len(todo)} mutants, {survived.total()} survive: {100 * survived.total() / max(len(todo), 1):.1f} %")


if __name__ == "__main__":
    main()
