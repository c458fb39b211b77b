"""Stage `correspond`: square views, pairs of them, and the pixels that correspond."""
