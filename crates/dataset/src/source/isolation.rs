//! Parsing in a process of its own. libhdf5 is C and crashes on hostile files, and so does a video decoder that was
//! translated from C; here they can crash, hang or eat memory alone. The program starts itself again, the child opens the file and answers requests over its standard
//! streams, under limits that it sets on itself first.

use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::sync::{Mutex, OnceLock, PoisonError};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec};
use rustix::process::{Resource, Rlimit};
use serde::{Deserialize, Serialize};

use super::codec::{Taker, put_array, put_demo};
use super::local::{Backend, MAX_FOLDERS};
use super::{open_backend, video};
use crate::error::InputError;
use crate::plan::{DemoPlan, Plan};
use crate::tree::{Array, Demo};

/// Set in a process that reads demonstrations: the file that it is to open.
const PATH_VARIABLE: &str = "ACTRM_HDF5_READER";
/// Set in a process that reads a video: the file that it is to open.
pub(super) const VIDEO_VARIABLE: &str = "ACTRM_VIDEO_READER";
/// Address space of the reading process, program text included.
const MEMORY: u64 = 900 << 20;
/// How long the reading process may compute, or sleep, without a word. Waiting for its turn on a busy machine, or for
/// a disk, does not count: a sound file may take long.
const SILENCE: Duration = Duration::from_secs(8);
/// How long it may be silent whatever it does.
const STALL: Duration = Duration::from_secs(120);
/// How often it is looked at.
const LOOK: Timespec = Timespec { tv_sec: 0, tv_nsec: 500_000_000 };
/// Processor time of the reading process: this, and a second for each so many bytes and files.
const CPU_SECONDS: u64 = 6;
const BYTES_PER_CPU_SECOND: u64 = 256 << 10;
const FILES_PER_CPU_SECOND: u64 = 100;
/// The longest answer.
const MAX_ANSWER: u64 = 384 << 20;
/// Demos of a plan that are sent together, and the most bytes of all of them.
const DEMOS_AT_ONCE: usize = 256;
const MAX_DEMOS: usize = 2 << 30;

pub(super) const PLAN: u8 = b'P';
const DEMOS: u8 = b'L';
const DEMO: u8 = b'D';
pub(super) const ARRAY: u8 = b'A';
pub(super) const ERROR: u8 = b'E';
pub(super) const BEAT: u8 = b'.';

/// The program that reads, once one is known.
static READER: OnceLock<PathBuf> = OnceLock::new();

/// First statement of `main`: in a reading process this serves its parent and never returns; in any other it
/// arms [`super::Source::open_isolated`] and returns at once.
pub fn serve_if_child() {
    type Serve = fn(&Path) -> std::io::Result<()>;
    for (variable, serve) in [(PATH_VARIABLE, serve as Serve), (VIDEO_VARIABLE, video::serve)] {
        if let Some(path) = std::env::var_os(variable) {
            let code = if serve(&PathBuf::from(path)).is_ok() { 0 } else { 1 };
            std::process::exit(code);
        }
    }
    // the link in /proc outlives a program that is replaced on disk while it runs
    serve_by(Path::new("/proc/self/exe"));
}

/// Arms [`super::Source::open_isolated`] with another program that calls [`serve_if_child`]: for a library in a program
/// that is not ours. The first program that is named stays.
pub fn serve_by(program: &Path) {
    READER.get_or_init(|| program.to_owned());
}

/// Whether a reading process can be started.
pub fn armed() -> bool {
    READER.get().is_some()
}

#[derive(Debug, Clone, Serialize, Deserialize)]
enum Request {
    Root { datasets: bool },
    Demo { index: usize, keys: Vec<String> },
    Rows { index: usize, key: String, first: usize, count: usize },
}

/// What a reading process can be asked.
pub(super) trait Ask: Serialize {
    /// What it asks for, for messages.
    fn words(&self) -> String;
}

impl Ask for Request {
    fn words(&self) -> String {
        match self {
            Self::Root { .. } => "read what belongs to no demo".to_owned(),
            Self::Demo { index, keys } => match keys.as_slice() {
                [] => format!("read the attributes of demo {index}"),
                [one] => format!("read {one} of demo {index}"),
                [first, .., last] => format!("read {first} to {last} of demo {index}"),
            },
            Self::Rows { index, key, .. } => format!("read {key} of demo {index}"),
        }
    }
}

// ---- the reading process ----

/// Bounds the memory and the processor time of this process; the latter may be raised up to `maximum`.
pub(super) fn limit_self(cpu_seconds: u64, maximum: Option<u64>) -> std::io::Result<()> {
    let set =
        |resource, value| rustix::process::setrlimit(resource, Rlimit { current: Some(value), maximum: Some(value) });
    set(Resource::Core, 0)?;
    set(Resource::As, MEMORY)?;
    limit_cpu(cpu_seconds, maximum)
}

/// Bounds the processor time of this process, up to what may be set later.
pub(super) fn limit_cpu(seconds: u64, maximum: Option<u64>) -> std::io::Result<()> {
    Ok(rustix::process::setrlimit(Resource::Cpu, Rlimit { current: Some(seconds), maximum })?)
}

/// Processor time for a file, or for everything in a folder.
fn cpu_seconds(path: &Path) -> u64 {
    fn add(path: &Path, depth: usize, (bytes, files): (&mut u64, &mut u64)) {
        match std::fs::read_dir(path) {
            Ok(entries) if depth > 0 => {
                for entry in entries.flatten() {
                    // links to folders may lead in a circle
                    let depth = if entry.file_type().is_ok_and(|kind| kind.is_dir()) { depth - 1 } else { 0 };
                    add(&entry.path(), depth, (&mut *bytes, &mut *files));
                }
            }
            _ => {
                *bytes += std::fs::metadata(path).map_or(0, |m| m.len());
                *files += 1;
            }
        }
    }
    let (mut bytes, mut files) = (0, 0);
    add(path, MAX_FOLDERS + 1, (&mut bytes, &mut files));
    seconds_for(bytes, files)
}

fn seconds_for(bytes: u64, files: u64) -> u64 {
    CPU_SECONDS + bytes / BYTES_PER_CPU_SECOND + files / FILES_PER_CPU_SECOND
}

fn serve(path: &Path) -> std::io::Result<()> {
    let first = cpu_seconds(path);
    limit_self(first, None)?;
    let mut out = std::io::stdout().lock();
    let _ = rustix::pipe::fcntl_setpipe_size(&out, 1 << 20);
    let mut beat_out = std::io::stdout();
    let opened = {
        drop(out);
        let mut beat = || {
            // a parent that has gone is noticed when the plan is sent
            let _ = send(&mut beat_out, BEAT, &[]);
        };
        open_backend(path, &mut beat)
    };
    out = std::io::stdout().lock();
    let local = match opened {
        Ok((local, plan)) => {
            // links may lead to more files
            let bytes = plan.files.iter().map(|(_, bytes)| bytes).sum();
            let seconds = first.max(seconds_for(bytes, plan.files.len() as u64));
            limit_cpu(seconds, Some(seconds))?;
            send_json(&mut out, PLAN, &plan.without_demos())?;
            plan.demos.chunks(DEMOS_AT_ONCE).try_for_each(|demos| send_json(&mut out, DEMOS, &demos))?;
            // no more
            send_json(&mut out, DEMOS, &[(); 0])?;
            local
        }
        Err(error) => return send(&mut out, ERROR, &serde_json::to_vec(&error)?),
    };
    let mut requests = std::io::stdin().lock();
    let mut body = Vec::new();
    while let Some(text) = next_request(&mut requests)? {
        body.clear();
        let (kind, failed) = match serde_json::from_slice(&text)? {
            Request::Root { datasets } => (DEMO, local.root(datasets).map(|root| put_demo(&mut body, &root)).err()),
            Request::Demo { index, keys } => {
                (DEMO, local.demo(index, &keys).map(|demo| put_demo(&mut body, &demo)).err())
            }
            Request::Rows { index, key, first, count } => {
                let rows = local.rows(index, &key, first, count);
                (ARRAY, rows.map(|array| put_array(&mut body, &array)).err())
            }
        };
        let failed = failed.or_else(|| {
            (body.len() as u64 > MAX_ANSWER).then(|| InputError::TooLarge {
                path: path.to_owned(),
                object: "one answer".to_owned(),
                bytes: body.len() as u64,
                limit: MAX_ANSWER,
            })
        });
        match failed {
            None => send(&mut out, kind, &body)?,
            Some(error) => send(&mut out, ERROR, &serde_json::to_vec(&error)?)?,
        }
    }
    Ok(())
}

/// The text of the next request; `None` when the parent is done.
pub(super) fn next_request(requests: &mut impl Read) -> std::io::Result<Option<Vec<u8>>> {
    let mut length = [0; 8];
    if requests.read_exact(&mut length).is_err() {
        return Ok(None);
    }
    let mut text = vec![0; usize::try_from(u64::from_le_bytes(length)).unwrap_or(0)];
    requests.read_exact(&mut text)?;
    Ok(Some(text))
}

/// Counts what is written.
struct Counted(u64);

impl Write for Counted {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0 += bytes.len() as u64;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

/// Sends an answer whose text need not fit memory.
fn send_json(out: &mut impl Write, kind: u8, value: &impl Serialize) -> std::io::Result<()> {
    let mut length = Counted(0);
    serde_json::to_writer(&mut length, value)?;
    let mut out = std::io::BufWriter::with_capacity(1 << 16, out);
    let mut head = [kind; 9];
    head[1..].copy_from_slice(&length.0.to_le_bytes());
    out.write_all(&head)?;
    serde_json::to_writer(&mut out, value)?;
    out.flush()
}

/// Sends one answer.
pub(super) fn send(out: &mut impl Write, kind: u8, body: &[u8]) -> std::io::Result<()> {
    let mut head = [kind; 9];
    head[1..].copy_from_slice(&(body.len() as u64).to_le_bytes());
    out.write_all(&head)?;
    out.write_all(body)?;
    out.flush()
}

// ---- its parent ----

/// The reading process as its parent sees it.
pub(super) struct Remote {
    path: PathBuf,
    state: Mutex<State>,
}

enum State {
    Alive {
        child: Child,
        requests: ChildStdin,
        answers: ChildStdout,
    },
    /// How it ended; every later request gets the same answer.
    Ended(InputError),
}

enum Failure {
    /// The answer was an error, the process lives on.
    Answered(InputError),
    /// No answer in time.
    Silent,
    /// The stream ended or held nonsense.
    Broken,
}

impl Remote {
    /// Starts a reading process on a file or folder and takes its plan.
    pub fn open(path: &Path) -> Result<(Self, Plan), InputError> {
        let (remote, mut plan): (Self, Plan) = Self::start(path, PATH_VARIABLE)?;
        let mut bytes = 0;
        loop {
            let (kind, body) = remote.exchange::<Request>(None)?;
            bytes += body.len();
            let mut demos: Vec<DemoPlan> = match serde_json::from_slice(&body) {
                Ok(demos) if kind == DEMOS && bytes <= MAX_DEMOS => demos,
                _ => {
                    let (path, reason) = (path.to_owned(), "its answer is no list of demos".to_owned());
                    return Err(InputError::ReaderStart { path, reason });
                }
            };
            if demos.is_empty() {
                return Ok((remote, plan));
            }
            let mut before = plan.demos.last();
            for demo in &mut demos {
                if let Some(before) = before {
                    demo.keys.share_names(&before.keys);
                }
                before = Some(demo);
            }
            plan.demos.extend(demos);
        }
    }

    /// Starts a process that reads `path` as the variable says, and takes what it says unasked.
    pub(super) fn start<T: serde::de::DeserializeOwned>(path: &Path, variable: &str) -> Result<(Self, T), InputError> {
        let cannot = |reason: String| InputError::ReaderStart { path: path.to_owned(), reason };
        let Some(program) = READER.get() else {
            return Err(cannot("the program has not called isolation::serve_if_child".to_owned()));
        };
        let mut child = Command::new(program)
            .env(variable, path)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .map_err(|e| cannot(e.to_string()))?;
        let requests = child.stdin.take().expect("stdin is a pipe");
        let answers = child.stdout.take().expect("stdout is a pipe");
        let remote = Self { path: path.to_owned(), state: Mutex::new(State::Alive { child, requests, answers }) };
        let (kind, body) = remote.exchange::<Request>(None)?;
        match serde_json::from_slice::<T>(&body) {
            Ok(plan) if kind == PLAN => Ok((remote, plan)),
            _ => Err(cannot("its first answer is no plan".to_owned())),
        }
    }

    /// Sends a request and takes the answer; `None` takes the answer that comes unasked.
    pub(super) fn exchange<R: Ask>(&self, request: Option<&R>) -> Result<(u8, Vec<u8>), InputError> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        let failure = match &mut *state {
            State::Ended(error) => return Err(error.clone()),
            State::Alive { child, requests, answers } => {
                let sent = request.is_none_or(|request| {
                    let text = serde_json::to_vec(request).expect("requests are plain data");
                    requests.write_all(&(text.len() as u64).to_le_bytes()).is_ok() && requests.write_all(&text).is_ok()
                });
                match if sent { receive(child.id(), answers) } else { Err(Failure::Broken) } {
                    Ok(answer) => return Ok(answer),
                    Err(failure) => failure,
                }
            }
        };
        let during = request.map_or_else(|| "open the file".to_owned(), Ask::words);
        let path = self.path.clone();
        if let Failure::Answered(error) = failure {
            return Err(error);
        }
        let State::Alive { mut child, .. } =
            std::mem::replace(&mut *state, State::Ended(InputError::NotFound { path: path.clone() }))
        else {
            unreachable!("only a living process fails");
        };
        let error = if let Failure::Silent = failure {
            let _ = child.kill();
            let _ = child.wait();
            InputError::ReaderSilent { path, during, seconds: SILENCE.as_secs() }
        } else {
            let how = match wait_briefly(&mut child) {
                Some(status) => ending(status),
                None => "gave an answer that makes no sense".to_owned(),
            };
            InputError::ReaderDied { path, during, how }
        };
        *state = State::Ended(error.clone());
        Err(error)
    }
}

/// Waits for a process whose stream has ended; kills it if it lives on.
fn wait_briefly(child: &mut Child) -> Option<std::process::ExitStatus> {
    for _ in 0..100 {
        if let Ok(Some(status)) = child.try_wait() {
            return Some(status);
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    let _ = child.kill();
    let _ = child.wait();
    None
}

fn ending(status: std::process::ExitStatus) -> String {
    use std::os::unix::process::ExitStatusExt;
    match status.signal() {
        Some(9 | 24) => "came to its limit of processor time, or was killed,".to_owned(),
        Some(6) => "came to its limit of memory or gave up (SIGABRT)".to_owned(),
        Some(11) => "crashed (SIGSEGV), so the file is damaged,".to_owned(),
        Some(n) => format!("crashed (signal {n})"),
        None => format!("ended with {}", status.code().unwrap_or(-1)),
    }
}

/// Waits for bytes, then reads; silence is an error.
struct Timed<'a> {
    process: u32,
    answers: &'a mut ChildStdout,
}

impl Read for Timed<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let since = Instant::now();
        let mut last = Look::at(self.process);
        let before = last.spent;
        let mut awake = since;
        loop {
            let mut fds = [PollFd::new(&*self.answers, PollFlags::IN)];
            match rustix::event::poll(&mut fds, Some(&LOOK)) {
                Ok(0) => {
                    let now = Look::at(self.process);
                    if !now.asleep || now.spent != last.spent {
                        awake = Instant::now();
                    }
                    let computed = now.spent.saturating_sub(before);
                    if computed.max(awake.elapsed()) >= SILENCE || since.elapsed() >= STALL {
                        return Err(std::io::ErrorKind::TimedOut.into());
                    }
                    last = now;
                }
                Ok(_) => return self.answers.read(buffer),
                Err(rustix::io::Errno::INTR) => {}
                Err(e) => return Err(e.into()),
            }
        }
    }
}

/// What a process was doing when it was looked at.
struct Look {
    /// Processor time so far.
    spent: Duration,
    /// It waits, and not for a disk.
    asleep: bool,
}

impl Look {
    /// Of a process that cannot be looked at: asleep, so that the clock decides.
    fn at(process: u32) -> Self {
        // behind the name, which stands in brackets and may hold anything: the state, and as the 11th and 12th field
        // after it user and system time, in hundredths of a second on every Linux
        std::fs::read_to_string(format!("/proc/{process}/stat"))
            .ok()
            .and_then(|text| {
                let mut fields = text.rsplit_once(')')?.1.split_ascii_whitespace();
                let asleep = fields.next()? == "S";
                let mut times = fields.skip(10).map(str::parse::<u64>);
                let (user, system) = (times.next()?.ok()?, times.next()?.ok()?);
                Some(Self { spent: Duration::from_millis(10 * (user + system)), asleep })
            })
            .unwrap_or(Self { spent: Duration::ZERO, asleep: true })
    }
}

fn receive(process: u32, answers: &mut ChildStdout) -> Result<(u8, Vec<u8>), Failure> {
    let failed = |e: std::io::Error| match e.kind() {
        std::io::ErrorKind::TimedOut => Failure::Silent,
        _ => Failure::Broken,
    };
    let mut answers = Timed { process, answers };
    loop {
        let mut head = [0; 9];
        answers.read_exact(&mut head).map_err(failed)?;
        let (kind, length) =
            (head[0], u64::from_le_bytes([head[1], head[2], head[3], head[4], head[5], head[6], head[7], head[8]]));
        if length > MAX_ANSWER {
            return Err(Failure::Broken);
        }
        let mut body = Vec::with_capacity(length.min(1 << 20) as usize);
        answers.by_ref().take(length).read_to_end(&mut body).map_err(failed)?;
        if body.len() as u64 != length {
            return Err(Failure::Broken);
        }
        match kind {
            BEAT => {}
            ERROR => {
                return Err(match serde_json::from_slice(&body) {
                    Ok(error) => Failure::Answered(error),
                    Err(_) => Failure::Broken,
                });
            }
            _ => return Ok((kind, body)),
        }
    }
}

impl Drop for Remote {
    fn drop(&mut self) {
        let state = self.state.get_mut().unwrap_or_else(PoisonError::into_inner);
        if let State::Alive { child, .. } = state {
            let _ = child.kill();
            let _ = child.wait();
        }
    }
}

impl Remote {
    fn ask<T>(
        &self,
        request: &Request,
        expected: u8,
        take: impl FnOnce(&mut Taker<'_>) -> Option<T>,
    ) -> Result<T, InputError> {
        let (kind, body) = self.exchange(Some(request))?;
        let taken = if kind == expected { take(&mut Taker(&body)) } else { None };
        taken.ok_or_else(|| InputError::ReaderDied {
            path: self.path.clone(),
            during: request.words(),
            how: "gave an answer that makes no sense".to_owned(),
        })
    }
}

impl Backend for Remote {
    fn root(&self, datasets: bool) -> Result<Demo, InputError> {
        self.ask(&Request::Root { datasets }, DEMO, |t| t.demo())
    }

    fn demo(&self, index: usize, keys: &[String]) -> Result<Demo, InputError> {
        self.ask(&Request::Demo { index, keys: keys.to_vec() }, DEMO, |t| t.demo())
    }

    fn rows(&self, index: usize, key: &str, first: usize, count: usize) -> Result<Array, InputError> {
        let request = Request::Rows { index, key: key.to_owned(), first, count };
        self.ask(&request, ARRAY, |t| t.array())
    }
}

#[cfg(test)]
mod tests {
    use std::os::unix::process::CommandExt;

    use super::*;

    fn silent_for(program: &str, arguments: &[&str]) -> (std::io::Result<usize>, Duration) {
        // in a group of its own: one that is stopped must not take others of the test's group along
        let mut child = Command::new(program)
            .args(arguments)
            .process_group(0)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("the program starts");
        let mut answers = child.stdout.take().expect("a pipe");
        let started = Instant::now();
        let read = Timed { process: child.id(), answers: &mut answers }.read(&mut [0; 16]);
        let waited = started.elapsed();
        let _ = child.kill();
        let _ = child.wait();
        (read, waited)
    }

    #[test]
    fn neither_sleep_nor_computing_goes_on_for_ever() {
        let sleeping = std::thread::spawn(|| silent_for("sh", &["-c", "read nothing"]));
        let (read, waited) = silent_for("sh", &["-c", "while :; do :; done"]);
        assert!(waited >= SILENCE, "{waited:?}");
        assert_eq!(read.expect_err("silence").kind(), std::io::ErrorKind::TimedOut);
        let (read, waited) = sleeping.join().expect("no panic");
        assert!(waited >= SILENCE, "{waited:?}");
        assert_eq!(read.expect_err("silence").kind(), std::io::ErrorKind::TimedOut);
    }

    #[test]
    fn a_process_that_waits_for_its_turn_is_waited_for() {
        // stopped is not asleep: it has something to do and nobody lets it
        let (read, waited) = silent_for("sh", &["-c", "(sleep 10; kill -CONT $$; echo yes) & kill -STOP $$; wait"]);
        assert!(waited >= SILENCE, "{waited:?}");
        assert!(read.expect("its word") > 0);
    }

    #[test]
    fn deep_folders_and_many_files_get_their_time() {
        let dir = tempfile::tempdir().expect("a folder");
        assert_eq!(cpu_seconds(dir.path()), CPU_SECONDS);
        let deep = dir.path().join("success/lab/2023-04-20/morning");
        std::fs::create_dir_all(&deep).expect("writable");
        let file = std::fs::File::create(deep.join("trajectory.h5")).expect("writable");
        file.set_len(10 * BYTES_PER_CPU_SECOND).expect("writable");
        for number in 1..2 * FILES_PER_CPU_SECOND {
            std::fs::write(deep.join(number.to_string()), "").expect("writable");
        }
        assert_eq!(cpu_seconds(dir.path()), CPU_SECONDS + 12);
        // a link to a folder above is not followed
        std::os::unix::fs::symlink(dir.path(), dir.path().join("again")).expect("writable");
        assert!(cpu_seconds(dir.path()) <= CPU_SECONDS + 13);
    }

    #[test]
    fn a_look_at_this_process_sees_its_time() {
        let before = Look::at(std::process::id()).spent;
        let started = Instant::now();
        while started.elapsed() < Duration::from_millis(300) {
            std::hint::black_box(0);
        }
        assert!(Look::at(std::process::id()).spent >= before);
        assert!(Look::at(std::process::id()).spent > Duration::ZERO);
        assert!(Look::at(u32::MAX).asleep);
    }
}
