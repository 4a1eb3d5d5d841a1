//! SQL over the frames and episodes of a data set.
//!
//! Apart from `dataset`, so that only programs that answer queries compile the SQL engine. [`query`] answers one
//! statement over two tables that are made of an opened [`dataset::Dataset`], which reads what it does not hold in memory.

mod sql;

pub use sql::{QueryError, QueryResult, Words, query, tables};
