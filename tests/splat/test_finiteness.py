"""Values that are not finite are named with the iteration at which they first were."""

from __future__ import annotations

import pytest
import torch

from pipelines.splat.gaussians import FinitenessMonitor, NonFiniteError

CPU = torch.device("cpu")


def scalars(a: float, b: float) -> dict[str, torch.Tensor]:
    return {"a": torch.tensor(a), "b": torch.tensor(b, dtype=torch.float64)}


def test_the_first_iteration_and_term_are_named_however_late_one_looks() -> None:
    monitor = FinitenessMonitor(("a", "b"), CPU)
    for iteration, (a, b) in enumerate([(1, 2), (1, float("inf")), (float("nan"), 2), (1, 1)], start=1):
        monitor.note(iteration, scalars(a, b))
    with pytest.raises(NonFiniteError, match="b is not finite at iteration 2") as caught:
        monitor.check()
    assert (caught.value.name, caught.value.iteration) == ("b", 2)


def test_finite_values_pass_and_a_reset_forgets() -> None:
    monitor = FinitenessMonitor(("a", "b"), CPU)
    monitor.note(1, scalars(1e30, -1e300))
    monitor.check()
    monitor.note(2, scalars(float("nan"), 0))
    monitor.reset()
    monitor.check()
    monitor.note(3, scalars(0, float("inf")))
    with pytest.raises(NonFiniteError) as caught:
        monitor.check()
    assert (caught.value.name, caught.value.iteration) == ("b", 3)
