"""Prepared sequences packed into WebDataset tars and an index."""
