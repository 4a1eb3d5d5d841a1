//! The tests of data sets, in one program: one link, and no core waits while the last test of a file runs.

#[path = "../common/mod.rs"]
mod common;
#[path = "../common/made.rs"]
mod made;

mod columns;
mod depth;
mod edit;
mod edited;
mod joined;
mod layouts;
mod lerobot;
mod planted;
mod planting;
mod unclean;
mod videos;
