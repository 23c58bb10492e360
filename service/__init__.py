"""HTTP service over :mod:`cvthead`: upload a portrait, get an id, render by id.

The model code is all in ``cvthead``; here are endpoints, queues, keys, limits and metrics.
"""
