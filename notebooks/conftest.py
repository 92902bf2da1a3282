"""Running the notebooks with nbmake: no network, one thread, and a budget of CPU seconds for each.

nbmake's own timeout is per cell. The budget is per notebook, stands in its metadata (`minicmdm.budget_s`, for the full
size) and is counted in CPU seconds of its kernel, so that a busy machine fails nobody.
"""

import json
import os

import pytest

os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")


def _children_seconds() -> float:
    times = os.times()  # of child processes that have ended (always 0 on Windows: no budget there)
    return times.children_user + times.children_system


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item):
    before = _children_seconds()
    result = yield
    if item.path.suffix == ".ipynb":
        budget = json.loads(item.path.read_text(encoding="utf-8"))["metadata"]["minicmdm"]["budget_s"]
        used = _children_seconds() - before
        if used > budget:
            pytest.fail(f"{item.path.name} took {used:.0f} s of CPU, and its budget is {budget} s", pytrace=False)
    return result
