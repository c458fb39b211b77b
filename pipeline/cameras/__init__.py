"""Stage `sfm`: where each frame was taken from, found by COLMAP or given."""
