"""Jobs on the workers of a Dask cluster. Needs the extra `cluster`; loaded only when asked for."""
