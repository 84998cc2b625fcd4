"""Experiments made of whole pipelines, on this machine or on a Dask cluster."""
