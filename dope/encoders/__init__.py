"""Encoders that were not trained here, under the same protocol: any callable, or a model in a local folder."""
