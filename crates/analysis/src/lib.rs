//! What a trained policy does inside: traces of an episode, linear probes, saliency of images, numbers of refinement steps.
//!
//! Everything here reads entries and runs them; nothing here changes an entry, a result or a training.

pub mod depth;
mod episode;
mod path_drawing;
pub mod probe;
mod saliency;
mod trace;

pub use saliency::{Saliency, SalientCamera, SalientQuery, saliency};
pub use trace::{Examiner, PolicyTrace, TracedQuery, TracedThought, trace};
