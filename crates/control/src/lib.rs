//! The compiled control loop that a robosuite worker loads.
