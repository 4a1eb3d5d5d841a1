//! Demonstrations: robomimic-family HDF5 in, LeRobot-ready Parquet out, windows for training.
