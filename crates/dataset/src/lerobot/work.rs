//! Conversion cut into pieces of work, each a row group of the output, done on several threads in any order
//! and delivered in order.

use super::features::Mapping;
use crate::plan::{DemoPlan, KeyPlan};
use crate::tree::Dtype;
use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::{Condvar, Mutex, PoisonError, mpsc};

/// Frames after which a row group of whole episodes is closed: setting up a column costs as much as packing some
/// hundred frames of it, and a reader of one episode unpacks no more than this many frames.
pub(crate) const GROUP_FRAMES: usize = 4096;
/// Raw bytes after which a row group is closed, and into which a large episode is cut.
pub(crate) const GROUP_BYTES: u64 = 8 << 20;
/// A dataset with more bytes a row than this is read by rows, never whole.
pub(crate) const BULK_ROW_BYTES: u64 = 4096;

/// What an element of bytes of any length is taken for.
const VAR_BYTES: u64 = 32 << 10;

/// Rows of one episode that go into one row group.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Part {
    /// The episode, which is the position of its demo in the plan.
    pub episode: usize,
    /// Its length.
    pub length: usize,
    /// First frame of the episode in the data set.
    pub first_frame: usize,
    /// Rows of the episode.
    pub rows: Range<usize>,
}

impl Part {
    /// Whether the episode begins here.
    pub(crate) fn begins(&self) -> bool {
        self.rows.start == 0
    }

    /// Whether the episode ends here.
    pub(crate) fn ends(&self) -> bool {
        self.rows.end == self.length
    }
}

/// Whether a dataset is read by rows: it is large and has a row a step.
pub(crate) fn is_bulk(key: &KeyPlan, length: usize) -> bool {
    key.shape.first() == Some(&length) && row_bytes(key) > BULK_ROW_BYTES
}

fn row_bytes(key: &KeyPlan) -> u64 {
    let rows = key.shape.first().copied().unwrap_or(1).max(1) as u64;
    match key.dtype {
        // files of pictures, whose sizes are known when they are read
        Dtype::VarBytes => VAR_BYTES,
        _ => key.bytes().unwrap_or(0) / rows,
    }
}

/// Cuts the demos into row groups: small episodes together, as long as they fit a file of `file_bytes`, a large one into
/// even pieces.
pub(crate) fn cut(demos: &[DemoPlan], mapping: &Mapping, lossless: bool, file_bytes: u64) -> Vec<Vec<Part>> {
    let full = GROUP_BYTES.min(file_bytes);
    let mut groups: Vec<Vec<Part>> = Vec::new();
    let mut open: Vec<Part> = Vec::new();
    let (mut frames, mut bytes) = (0, 0_u64);
    let mut first_frame = 0;
    for (episode, demo) in demos.iter().enumerate() {
        let mut block = 1;
        let per_row: u64 = match lossless {
            true => demo.keys.values().map(row_bytes).fold(0, u64::saturating_add),
            false => mapping.image_bytes_per_frame() as u64,
        };
        for key in demo.keys.values().filter(|key| is_bulk(key, demo.length)) {
            block = block.max(key.block_rows);
        }
        let total = per_row.saturating_mul(demo.length as u64);
        let part = |rows| Part { episode, length: demo.length, first_frame, rows };
        if total > GROUP_BYTES {
            if !open.is_empty() {
                groups.push(std::mem::take(&mut open));
            }
            (frames, bytes) = (0, 0);
            let pieces = total.div_ceil(GROUP_BYTES) as usize;
            // a stored block that is cut in two would be decoded twice
            let step = demo.length.div_ceil(pieces).next_multiple_of(block.clamp(1, demo.length));
            let starts = (0..demo.length).step_by(step);
            groups.extend(starts.map(|from| vec![part(from..(from + step).min(demo.length))]));
        } else {
            if !open.is_empty() && (frames + demo.length > GROUP_FRAMES || bytes + total > full) {
                groups.push(std::mem::take(&mut open));
                (frames, bytes) = (0, 0);
            }
            open.push(part(0..demo.length));
            frames += demo.length;
            bytes += total;
        }
        first_frame += demo.length;
    }
    if !open.is_empty() {
        groups.push(open);
    }
    groups
}

/// Pieces that may be done but not yet delivered, for each thread: bounds the memory held.
const AHEAD_PER_THREAD: usize = 2;

struct Turn {
    next: usize,
    delivered: usize,
    stopped: bool,
}

/// Tells the other threads to stop where this one panics: none waits for a result that never comes.
struct StopOnPanic<'t>(&'t Mutex<Turn>, &'t Condvar);

impl Drop for StopOnPanic<'_> {
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.0.lock().unwrap_or_else(PoisonError::into_inner).stopped = true;
            self.1.notify_all();
        }
    }
}

/// Does `count` pieces of work on `jobs` threads and hands the results to `deliver` in order, on this thread.
/// The first error, in order, ends it.
pub(crate) fn in_order<T: Send, E: Send>(
    count: usize,
    jobs: usize,
    work: impl Fn(usize) -> Result<T, E> + Sync,
    mut deliver: impl FnMut(T) -> Result<(), E>,
) -> Result<(), E> {
    let turn = Mutex::new(Turn { next: 0, delivered: 0, stopped: false });
    let moved = Condvar::new();
    let ahead = jobs * AHEAD_PER_THREAD;
    let lock = || turn.lock().unwrap_or_else(PoisonError::into_inner);
    std::thread::scope(|scope| {
        let (send, receive) = mpsc::channel();
        for _ in 0..jobs.min(count) {
            let send = send.clone();
            let (work, lock, turn, moved) = (&work, &lock, &turn, &moved);
            scope.spawn(move || {
                let _stop = StopOnPanic(turn, moved);
                loop {
                    let mut turn = lock();
                    while !turn.stopped && turn.next < count && turn.next >= turn.delivered + ahead {
                        turn = moved.wait(turn).unwrap_or_else(PoisonError::into_inner);
                    }
                    if turn.stopped || turn.next >= count {
                        return;
                    }
                    let mine = turn.next;
                    turn.next += 1;
                    drop(turn);
                    if send.send((mine, work(mine))).is_err() {
                        return;
                    }
                }
            });
        }
        drop(send);
        let mut waiting = BTreeMap::new();
        let mut outcome = Ok(());
        let mut due = 0;
        'receiving: for (index, result) in receive {
            waiting.insert(index, result);
            while let Some(result) = waiting.remove(&due) {
                outcome = result.and_then(&mut deliver);
                if outcome.is_err() {
                    break 'receiving;
                }
                due += 1;
                lock().delivered = due;
                moved.notify_all();
            }
        }
        lock().stopped = true;
        moved.notify_all();
        outcome
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn results_come_in_order_whatever_the_number_of_threads() {
        for jobs in [1, 2, 7] {
            let mut got = Vec::new();
            let done: Result<(), ()> = in_order(
                100,
                jobs,
                |i| {
                    std::thread::sleep(std::time::Duration::from_micros((i as u64 * 37) % 200));
                    Ok(i * i)
                },
                |v| {
                    got.push(v);
                    Ok(())
                },
            );
            done.unwrap();
            assert_eq!(got, (0..100).map(|i| i * i).collect::<Vec<_>>());
        }
    }

    #[test]
    fn a_panic_ends_the_work() {
        let work = |i| if i == 0 { panic!("on purpose") } else { Ok::<usize, ()>(i) };
        let done = std::panic::catch_unwind(|| in_order(1000, 3, work, |_| Ok(())));
        assert!(done.is_err());
    }

    #[test]
    fn the_first_error_in_order_ends_the_work() {
        let mut got = 0;
        let done = in_order(
            1000,
            3,
            |i| if i >= 20 { Err(i) } else { Ok(i) },
            |_| {
                got += 1;
                Ok(())
            },
        );
        assert_eq!((done, got), (Err(20), 20));
        let done: Result<(), &str> = in_order(1000, 3, Ok, |i| if i == 5 { Err("full") } else { Ok(()) });
        assert_eq!(done, Err("full"));
        let done: Result<(), ()> = in_order(0, 3, |_| Ok(()), |()| Ok(()));
        assert_eq!(done, Ok(()));
    }
}
