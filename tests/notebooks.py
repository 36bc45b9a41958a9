"""Make the notebooks of docs/ of the scripts beside them, and run their cells without Jupyter.

python -m tests.notebooks

writes each notebook again. A script is in the percent format: `# %%` begins a cell of code and
`# %% [markdown]` one of text, whose lines are comments.
"""

import ast
import contextlib
import io
import json
import re

from tests.documents import DOCS

SCRIPTS = sorted(DOCS.glob("tutorials/*.py"))
CELL = re.compile(r"^# %%( \[markdown\])?\n", re.MULTILINE)


def cells(script):
    """Pairs (type, text) of the cells of a script."""
    _, *parts = CELL.split(script.read_text(encoding="utf-8"))
    for mark, text in zip(parts[::2], parts[1::2], strict=True):
        if mark:
            yield "markdown", re.sub(r"^# ?", "", text.strip(), flags=re.MULTILINE)
        else:
            yield "code", text.strip()


def notebook(script):
    """The text of the notebook of a script, in format 4.5 of nbformat, without outputs."""
    found = []
    for k, (kind, text) in enumerate(cells(script)):
        code = {"execution_count": None, "outputs": []} if kind == "code" else {}
        source = text.splitlines(keepends=True)
        found.append(
            {"cell_type": kind, "id": f"cell-{k}", "metadata": {}, **code, "source": source}
        )
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    whole = {
        "cells": found,
        "metadata": {"kernelspec": kernel, "language_info": {"name": "python"}},
        "nbformat": 4,
        "nbformat_minor": 5,
    }
    return json.dumps(whole, indent=1) + "\n"


def run_cells(path):
    """Run the code of a notebook in one namespace; return what each cell prints, and shows by its
    last expression, as text.
    """
    names, shown = {"__name__": "__main__"}, []
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] != "code":
            continue
        out, tree = io.StringIO(), ast.parse("".join(cell["source"]))
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        with contextlib.redirect_stdout(out):
            exec(compile(tree, path.name, "exec"), names)
            value = eval(ast.unparse(last), names) if last else None
        if value is not None:
            out.write(f"{value!r}\n")
        shown.append(out.getvalue())
    return shown


if __name__ == "__main__":
    for script in SCRIPTS:
        script.with_suffix(".ipynb").write_text(notebook(script), encoding="utf-8")
