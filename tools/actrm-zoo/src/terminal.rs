//! Progress bars on standard error; nothing where it is not a terminal.

use std::time::Duration;

use indicatif::{ProgressBar, ProgressStyle};

/// A bar of `total` steps in the look that all commands share.
pub fn bar(what: &'static str, total: u64) -> ProgressBar {
    let style = "{prefix:.bold} {wide_bar} {pos}/{len} [{elapsed} < {eta}] {msg}";
    let style = ProgressStyle::with_template(style).expect("the template is sound");
    let bar = ProgressBar::new(total).with_style(style).with_prefix(what);
    bar.enable_steady_tick(Duration::from_millis(200));
    bar
}
