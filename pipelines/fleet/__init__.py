"""Many recordings on dask.distributed: Monte Carlo studies and fleets. Needs the extra `alidade[fleet]`."""
