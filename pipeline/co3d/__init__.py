"""CO3D as released (v1 and v2): annotations, cameras, images, masks and depths become prepared sequences."""
