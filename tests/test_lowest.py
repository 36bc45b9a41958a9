"""The lowest versions that are tested are the lowest that are allowed."""

import re
import tomllib

from tests.conftest import ROOT


def test_lowest_versions_are_those_of_pyproject():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    groups = project["optional-dependencies"]
    wanted = [*project["dependencies"], *groups["plot"], *groups["cluster"], *groups["test"]]
    lines = (ROOT / ".ci" / "lowest.txt").read_text().splitlines()
    tested = dict(line.split("==") for line in lines if not line.startswith("#"))
    allowed = dict(re.findall(r"^([a-z0-9-]+)>=([0-9.]+)", "\n".join(wanted), flags=re.MULTILINE))
    assert len(allowed) >= 15
    for name, version in allowed.items():
        padded = [*version.split("."), "0", "0"][:3]
        assert [*tested[name].split("."), "0", "0"][:3] == padded, name
