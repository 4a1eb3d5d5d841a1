//! What the tests over real workers share: the same as those of `rollout`.

#[path = "../../../rollout/tests/common/mod.rs"]
mod workers;

#[allow(unused_imports, reason = "each test file uses its part")]
pub use workers::*;
