//! Policies over the network: openpi's protocol (WebSocket, MessagePack, NumPy arrays), as a server and as a client.
//!
//! The client speaks first to open a WebSocket. The server then sends one binary message, a map that describes the policy.
//! From then on every binary message of the client is an observation, a map by key, and is answered by a binary message,
//! a map with `actions` (T, A) in `float32`, or by a text message that says in one line what is wrong.
//!
//! Three keys of an observation belong to the episode, which openpi has no message for: `reset: true` or `seed` begins one,
//! and `executed` says how many actions of the last chunk were executed, where that is not `n_action_steps`. A policy that
//! reads several observations gets them with a leading axis, oldest first.
//!
//! Under the path `/vla-eval` the server speaks vla-eval's protocol instead, which is asked for an action at every step.

mod client;
mod codec;
mod error;
mod mapping;
mod resize;
mod server;
mod session;
#[cfg(test)]
mod tests;
mod vla_eval;

pub use client::{Facts, RemotePolicy};
pub use codec::{Array, Dtype, Kind, Value, decode, encode};
pub use error::{Result, ServingError};
pub use mapping::{Flip, Item, Mapping};
pub use server::{Limits, Server};
pub use session::{Service, Session};
pub use vla_eval::{PATH as VLA_EVAL_PATH, Shown, Stepper, Steps};
