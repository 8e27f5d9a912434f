"""What the house weighs: `python .ci/weigh.py` prints it, and exits with 1 where a bound is passed.

Bounds are what was reached; whoever makes it lighter lowers them. Code are lines that are neither
blank, comment nor docstring; core is `measure/` alone.
"""

from __future__ import annotations

import ast
import collections
import io
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

BOUNDS = {
    "code": 50_400,
    "core": 26_000,
    "kernels": 213,  # 150 is wanted
    "constants": 1_045,  # numbers that are named in modules; 650 is wanted
    "lines of a file": 400,
    "tests": 41_575,  # lines of their files; 30,000 is wanted
    "docs": 6_500,  # lines of pages
    "starred tuples": 0,  # calls with a local tuple and a star
    "long signatures": 0,  # of more than 8 parameters
    "names twice": 0,  # of classes
}
KERNELS = {"compiled", "folded", "inlined", "njit"}
NO_CODE = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT,
    tokenize.ENDMARKER,
}  # fmt: skip


def code_lines(text: str, tree: ast.Module) -> int:
    """Lines of code."""
    told = {
        line
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if isinstance(node.value.value, str)
        for line in range(node.lineno, (node.end_lineno or node.lineno) + 1)
    }
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    used = (range(t.start[0], t.end[0] + 1) for t in tokens if t.type not in NO_CODE)
    return len({line for lines in used for line in lines} - told)


def numbers(tree: ast.Module) -> int:
    """Names that a module gives to numbers."""
    count = 0
    for node in tree.body:
        if isinstance(node, ast.Assign):
            pairs = isinstance(node.value, ast.Tuple) and isinstance(node.targets[0], ast.Tuple)
            values = node.value.elts if pairs else [node.value]
            count += sum(
                isinstance(v, ast.Constant) and type(v.value) in (int, float) for v in values
            )
    return count


def functions(tree: ast.Module) -> Iterator[tuple[str, int]]:
    """What is wrong, or counted, of functions."""
    for node in ast.walk(tree):
        if not isinstance(node, ast.FunctionDef):
            continue
        called = (getattr(d, "func", d) for d in node.decorator_list)
        yield "kernels", any(getattr(d, "id", "") in KERNELS for d in called)
        taken = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        own = bool(taken) and taken[0].arg in ("self", "cls")
        yield "long signatures", len(taken) - own > 8
        tuples = {
            name.id
            for a in ast.walk(node)
            if isinstance(a, ast.Assign) and isinstance(a.value, ast.Tuple)
            for name in a.targets
            if isinstance(name, ast.Name)
        }
        for call in (c for c in ast.walk(node) if isinstance(c, ast.Call)):
            starred = (a.value for a in call.args if isinstance(a, ast.Starred))
            yield (
                "starred tuples",
                sum(isinstance(one, ast.Name) and one.id in tuples for one in starred),
            )


def weigh() -> dict[str, int]:
    """All counts of this checkout."""
    counts, classes = collections.Counter[str](), collections.Counter[str]()
    for path in (p for folder in ("measure", "plugins") for p in Path(folder).rglob("*.py")):
        text = path.read_text("utf-8")
        tree = ast.parse(text)
        code = code_lines(text, tree)
        counts["code"] += code
        counts["core"] += code * (path.parts[0] == "measure")
        counts["constants"] += numbers(tree)
        counts["lines of a file"] = max(counts["lines of a file"], text.count("\n"))
        for what, count in functions(tree):
            counts[what] += count
        classes.update(n.name.lstrip("_") for n in ast.walk(tree) if isinstance(n, ast.ClassDef))
    tests = Path("tests").rglob("*.py")
    counts["tests"] = sum(path.read_text("utf-8").count("\n") for path in tests)
    pages = Path("docs").rglob("*.md")
    counts["docs"] = sum(path.read_text("utf-8").count("\n") for path in pages)
    counts["names twice"] = sum(n > 1 for name, n in classes.items() if name != "Config")
    return dict(counts)


def main() -> None:
    """Print counts and bounds."""
    counts = weigh()
    for what, bound in BOUNDS.items():
        print(f"{what} {counts[what]}, at most {bound}")
    sys.exit(any(counts[what] > bound for what, bound in BOUNDS.items()))


if __name__ == "__main__":
    main()
