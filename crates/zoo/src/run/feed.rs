//! The batches of a training, in order: gathered when they are needed, or, where pictures are read from a file, one step
//! ahead by a thread of their own while the step before is computed. Which windows make a batch is the sampler's.

use std::ops::Range;
use std::sync::Arc;
use std::thread::JoinHandle;

use dataset::shuffle::Sampler;
use dataset::{DatasetError, WindowBatch, Windows};

use crate::experiment::BeginningSection;

/// A batch under way.
type Coming = JoinHandle<Result<WindowBatch, DatasetError>>;

/// Gathers the windows of each step.
pub(super) struct Feed {
    sampler: Sampler,
    /// What is drawn more often than the rest.
    beginning: Option<BeginningSection>,
    /// The windows that are drawn once an epoch, by number, as often as they stand here; all of them where empty.
    drawn: Vec<u32>,
    /// Steps that there will be.
    steps: u64,
    batch: WindowBatch,
    /// The windows, shared with the thread that reads ahead; set when there is one.
    shared: Option<Arc<Windows>>,
    /// The step that is being gathered.
    ahead: Option<(u64, Coming)>,
}

impl Feed {
    pub fn new(sampler: Sampler, beginning: Option<BeginningSection>, steps: u64) -> Self {
        Self { sampler, beginning, drawn: Vec::new(), steps, batch: WindowBatch::default(), shared: None, ahead: None }
    }

    /// The windows of step `step`, counted from 0. `windows` are always the same.
    ///
    /// # Errors
    /// A file of pictures that cannot be read.
    pub fn take(&mut self, windows: &Windows, step: u64) -> Result<&mut WindowBatch, DatasetError> {
        if !windows.reads_files() {
            windows.try_gather(&self.indices(windows, step), &mut self.batch)?;
            return Ok(&mut self.batch);
        }
        let ready = self.ahead.take().map(|(of, coming)| (of, coming.join().expect("gathering does not panic")));
        match ready {
            Some((of, gathered)) if of == step => self.batch = gathered?,
            // the first step of a session
            _ => windows.try_gather(&self.indices(windows, step), &mut self.batch)?,
        }
        if step + 1 < self.steps {
            let windows = Arc::clone(self.shared.get_or_insert_with(|| Arc::new(windows.clone())));
            let indices = self.indices(&windows, step + 1);
            let gather = move || {
                let mut batch = WindowBatch::default();
                windows.try_gather(&indices, &mut batch).map(|()| batch)
            };
            self.ahead = Some((step + 1, std::thread::spawn(gather)));
        }
        Ok(&mut self.batch)
    }

    /// Which windows step `step` has.
    fn indices(&mut self, windows: &Windows, step: u64) -> Vec<u32> {
        let Some(beginning) = self.beginning else { return self.sampler.batch(windows.len(), step) };
        if self.drawn.is_empty() {
            self.drawn = with_beginnings(&windows.episodes(), beginning);
        }
        self.sampler.batch(self.drawn.len(), step).iter().map(|&at| self.drawn[at as usize]).collect()
    }
}

/// The windows of all episodes, the first ones of each as often as asked.
fn with_beginnings(episodes: &[Range<u32>], beginning: BeginningSection) -> Vec<u32> {
    let times = |at: usize| if at < beginning.steps { beginning.times } else { 1 };
    let windows = episodes.iter().flat_map(|episode| episode.clone().enumerate());
    windows.flat_map(|(at, window)| std::iter::repeat_n(window, times(at))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_windows_of_an_episode_are_there_as_often_as_asked() {
        let windows = with_beginnings(&[0..3, 3..4, 4..8], BeginningSection { steps: 2, times: 3 });
        assert_eq!(windows, [0, 0, 0, 1, 1, 1, 2, 3, 3, 3, 4, 4, 4, 5, 5, 5, 6, 7]);
    }
}
