"""Execution of the tasks of a calibration: in this process, in worker processes, or on a dask cluster."""
