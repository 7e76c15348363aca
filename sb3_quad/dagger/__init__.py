"""Stage one: data aggregation (DAgger), as thesis 4.2.1 and Algorithm 3 describe it."""

from sb3_quad.dagger.dagger import DAgger
from sb3_quad.dagger.dataset import AggregatedDataset

__all__ = ["AggregatedDataset", "DAgger"]
