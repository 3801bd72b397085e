"""Engines that run tasks on workers: of this machine, or of a Dask cluster."""
