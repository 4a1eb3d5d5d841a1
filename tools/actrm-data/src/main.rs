//! Command line for demonstrations and data sets.

fn main() {}
