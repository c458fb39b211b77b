"""Data preparation: raw videos and photos to WebDataset shards of pixel correspondences.

Read `sequence.py` first: every stage reads and writes that one form on disk.
"""
