//! The batches of a training, in order: gathered when they are needed, or, where pictures are read from a file, one step
//! ahead by a thread of their own while the step before is computed. Which windows make a batch is the sampler's.

use std::sync::Arc;
use std::thread::JoinHandle;

use dataset::shuffle::Sampler;
use dataset::{DatasetError, WindowBatch, Windows};

/// A batch under way.
type Coming = JoinHandle<Result<WindowBatch, DatasetError>>;

/// Gathers the windows of each step.
pub(super) struct Feed {
    sampler: Sampler,
    /// The windows of an epoch by number, each as often as it is drawn; absent: every window once.
    drawn: Option<Vec<u32>>,
    /// Steps that there will be.
    steps: u64,
    batch: WindowBatch,
    /// The windows, shared with the thread that reads ahead; set when there is one.
    shared: Option<Arc<Windows>>,
    /// The step that is being gathered.
    ahead: Option<(u64, Coming)>,
}

impl Feed {
    pub fn new(sampler: Sampler, drawn: Option<Vec<u32>>, steps: u64) -> Self {
        Self { sampler, drawn, steps, batch: WindowBatch::default(), shared: None, ahead: None }
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
        match &self.drawn {
            Some(drawn) => self.sampler.batch(drawn.len(), step).iter().map(|&at| drawn[at as usize]).collect(),
            None => self.sampler.batch(windows.len(), step),
        }
    }
}
