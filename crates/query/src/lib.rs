//! SQL over the frames and episodes of a data set.
