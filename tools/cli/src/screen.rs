//! A bar on standard error, and lines above it.

use std::borrow::Cow;
use std::io::IsTerminal;
use std::time::Duration;

use anyhow::Result;
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::text::plain;

/// What a command shows while it works: at most one bar, nothing where standard error is no terminal.
///
/// Lines that are printed through it come above the bar. Whatever way the command ends, no bar stays behind.
#[derive(Default)]
pub struct Screen {
    bar: Option<ProgressBar>,
}

impl Screen {
    /// Without a bar.
    pub fn new() -> Self {
        Self::default()
    }

    /// A bar of `total` steps in the place of what was there.
    pub fn begin(&mut self, what: impl Into<Cow<'static, str>>, total: u64) {
        self.begin_at(what, 0, total);
    }

    /// A bar of `total` steps, the first `done` of which were there before.
    pub fn begin_at(&mut self, what: impl Into<Cow<'static, str>>, done: u64, total: u64) {
        // a line of its own for the message: in one line with it, the bar would have no room in 80 columns
        let bar = self.replace("{prefix:.bold} {wide_bar} {pos}/{len} [{elapsed} < {eta}]", what.into());
        bar.set_length(total);
        bar.set_position(done);
        bar.reset_eta();
    }

    /// A sign of life for work of unknown length.
    pub fn spin(&mut self, what: impl Into<Cow<'static, str>>) {
        self.replace("{spinner} {prefix} [{elapsed}]", what.into());
    }

    fn replace(&mut self, template: &str, what: Cow<'static, str>) -> &ProgressBar {
        self.clear();
        let target = match std::io::stderr().is_terminal() {
            true => ProgressDrawTarget::stderr(),
            false => ProgressDrawTarget::hidden(),
        };
        let style = ProgressStyle::with_template(template).expect("the template is sound");
        let bar = ProgressBar::with_draw_target(Some(0), target).with_style(style).with_prefix(plain(&what));
        bar.enable_steady_tick(Duration::from_millis(200));
        self.bar.insert(bar)
    }

    /// How far the bar is.
    pub fn at(&self, done: u64) {
        if let Some(bar) = &self.bar {
            bar.set_position(done);
        }
    }

    /// Tells how far work is whose length becomes known on the way: makes the bar, and moves it.
    pub fn advance(&mut self, what: &'static str) -> impl FnMut(u64, u64) + '_ {
        move |done, total| match &self.bar {
            Some(bar) if bar.length() == Some(total) => bar.set_position(done),
            _ => self.begin_at(what, done, total),
        }
    }

    /// Whether the bar has reached its end.
    pub fn is_full(&self) -> bool {
        self.bar.as_ref().is_some_and(|bar| bar.length() == Some(bar.position()))
    }

    /// One step further.
    pub fn step(&self) {
        if let Some(bar) = &self.bar {
            bar.inc(1);
        }
    }

    /// A message below the bar, cut to the terminal's width.
    pub fn message(&self, text: &str) {
        let Some(bar) = &self.bar else { return };
        if bar.message().is_empty() && !text.is_empty() {
            let template = "{prefix:.bold} {wide_bar} {pos}/{len} [{elapsed} < {eta}]\n{wide_msg}";
            bar.set_style(ProgressStyle::with_template(template).expect("the template is sound"));
        }
        bar.set_message(plain(text));
    }

    /// A line on standard error, above the bar.
    pub fn note(&self, text: &str) {
        match &self.bar {
            Some(bar) => bar.suspend(|| crate::note(text)),
            None => crate::note(text),
        }
    }

    /// Text on standard output, above the bar.
    ///
    /// # Errors
    /// As [`crate::print()`].
    pub fn print(&self, text: &str) -> Result<()> {
        match &self.bar {
            Some(bar) => bar.suspend(|| crate::print(text)),
            None => crate::print(text),
        }
    }

    /// Takes the bar away.
    pub fn clear(&mut self) {
        if let Some(bar) = self.bar.take() {
            bar.finish_and_clear();
        }
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        self.clear();
    }
}
