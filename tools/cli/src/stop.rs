//! Ctrl-C and the signals that ask a program to end: once is enough, at any time.
//!
//! A second signal asks for nothing new: `timeout` sends two, and people press Ctrl-C twice. The third ends the program at once.

use std::io::{IsTerminal, Write};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use anyhow::{Context, Result};

/// Exit code of a program that an interrupt ended, as shells have it.
pub const INTERRUPTED: u8 = 130;

/// How long work may take to end by itself once it is asked to.
const PATIENCE: Duration = Duration::from_millis(1500);

/// The signal that ends the program at once, whatever it is doing.
const AT_ONCE: usize = 3;

/// Whether the program was asked to end. Everything that is finished is on disk already, so that a program whose work
/// does not end in time is ended as it is.
#[derive(Clone)]
pub struct Stop {
    /// signals that came
    asked: Arc<AtomicUsize>,
    patient: Arc<AtomicBool>,
    last_act: Arc<Mutex<Option<LastAct>>>,
}

type LastAct = Box<dyn FnOnce() + Send>;

impl Stop {
    /// Catches the signals from now on. `last_words` are said by a program that is ended as it is.
    ///
    /// # Errors
    /// When the system refuses.
    pub fn install(last_words: &'static str) -> Result<Self> {
        let stop = Self { asked: Arc::default(), patient: Arc::default(), last_act: Arc::default() };
        let handled = stop.clone();
        ctrlc::set_handler(move || {
            match handled.asked.fetch_add(1, Ordering::SeqCst) + 1 {
                1 => {
                    let waiting = handled.clone();
                    // this thread has to listen for further signals
                    std::thread::spawn(move || waiting.end_after_patience(last_words));
                }
                AT_ONCE.. => handled.end(last_words),
                _ => {}
            }
        })
        .context("cannot handle Ctrl-C")?;
        Ok(stop)
    }

    /// Whether somebody asked.
    pub fn asked(&self) -> bool {
        self.asked.load(Ordering::SeqCst) > 0
    }

    /// While `yes`, work is waited for however long it takes to end: a training, which has a checkpoint to save.
    pub fn wait_for_work(&self, yes: bool) {
        self.patient.store(yes, Ordering::SeqCst);
    }

    /// The same question for other threads.
    pub fn flag(&self) -> Arc<dyn Fn() -> bool + Send + Sync> {
        let asked = Arc::clone(&self.asked);
        Arc::new(move || asked.load(Ordering::SeqCst) > 0)
    }

    /// What a program that is ended as it is does last: it removes what it has begun to write.
    pub fn last_act(&self, act: impl FnOnce() + Send + 'static) {
        *self.last_act.lock().unwrap_or_else(PoisonError::into_inner) = Some(Box::new(act));
    }

    fn end_after_patience(&self, last_words: &str) {
        let until = Instant::now() + PATIENCE;
        while Instant::now() < until || self.patient.load(Ordering::SeqCst) {
            std::thread::sleep(Duration::from_millis(20));
        }
        self.end(last_words);
    }

    fn end(&self, last_words: &str) {
        if let Some(act) = self.last_act.lock().unwrap_or_else(PoisonError::into_inner).take() {
            act();
        }
        if std::io::stderr().is_terminal() {
            // a bar may stand in this line
            let _ = std::io::stderr().write_all(b"\r\x1b[2K");
        }
        crate::note(last_words);
        std::process::exit(i32::from(INTERRUPTED));
    }
}
