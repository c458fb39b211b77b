"""Pictures of what the descriptors have learnt: the same colour on the same part, and where a point is found again."""

from dope.figures.from_shards import draw_figures, figure_for

__all__ = ["draw_figures", "figure_for"]
