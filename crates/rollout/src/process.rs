//! A child process in a process group of its own, spoken to over non-blocking pipes with deadlines.
//!
//! Nothing here knows the protocol. A [`Process`] is killed with its children when it is dropped.

use std::fs::File;
use std::io::{ErrorKind, Read, Seek, SeekFrom, Write};
use std::os::fd::AsFd;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, ExitStatus, Stdio};
use std::sync::{Mutex, PoisonError, mpsc};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::process::{Pid, Resource, Rlimit, Signal, WaitId, WaitIdOptions, kill_process_group, prlimit, waitid};

use crate::error::{FaultKind, RolloutError};
use crate::frame::checked_length;
use crate::stop::Stop;

/// How much of a worker's stderr an error shows.
const TAIL_LINES: usize = 6;
const TAIL_BYTES: u64 = 4096;

/// A supervised child with its two pipes and the file that takes its stderr.
pub(super) struct Process {
    child: Child,
    stdin: Option<ChildStdin>,
    stdout: ChildStdout,
    log: PathBuf,
    /// Whether it has been reaped, and its children killed before: its id may be another's by now.
    reaped: bool,
    /// The process that started it; after a fork the other one has only a copy of this.
    owner: u32,
}

impl Process {
    /// Starts `command` in its own process group, its stderr going to the file `log`.
    pub(super) fn spawn(mut command: Command, log: &Path, memory_limit: Option<u64>) -> Result<Self, RolloutError> {
        let program = PathBuf::from(command.get_program());
        let file = |operation| move |source| RolloutError::File { operation, path: log.to_owned(), source };
        let stderr = File::create(log).map_err(file("creating worker log"))?;
        let spawned = |source| RolloutError::Spawn { program: program.clone(), source };
        command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(stderr).process_group(0);
        let mut child = spawn_for_good(command).map_err(spawned)?;
        let stdin = child.stdin.take().expect("stdin is piped");
        let stdout = child.stdout.take().expect("stdout is piped");
        let (log, owner) = (log.to_owned(), std::process::id());
        let process = Self { child, stdin: Some(stdin), stdout, log, reaped: false, owner };
        process.prepare(memory_limit).map_err(spawned)?;
        Ok(process)
    }

    fn prepare(&self, memory_limit: Option<u64>) -> std::io::Result<()> {
        if let Some(stdin) = &self.stdin {
            rustix::io::ioctl_fionbio(stdin, true)?;
        }
        rustix::io::ioctl_fionbio(&self.stdout, true)?;
        if let Some(bytes) = memory_limit {
            let limit = Rlimit { current: Some(bytes), maximum: Some(bytes) };
            prlimit(Some(Pid::from_child(&self.child)), Resource::Data, limit)?;
        }
        Ok(())
    }

    /// Whether this process started it, and not the one that this one was forked from.
    pub(super) fn is_own(&self) -> bool {
        self.owner == std::process::id()
    }

    /// The process id, which is also the id of its group.
    pub(super) fn id(&self) -> u32 {
        self.child.id()
    }

    /// The file that takes its stderr.
    pub(super) fn log(&self) -> &Path {
        &self.log
    }

    /// Writes all of `bytes` before `deadline`.
    pub(super) fn send(&mut self, bytes: &[u8], limit: Limit<'_>) -> Result<(), FaultKind> {
        let mut rest = bytes;
        while !rest.is_empty() {
            let Some(stdin) = &mut self.stdin else {
                return Err(FaultKind::Died("its pipe is closed".to_owned()));
            };
            match stdin.write(rest) {
                Ok(written) => rest = &rest[written..],
                Err(error) if error.kind() == ErrorKind::WouldBlock => {
                    limit.wait(stdin, PollFlags::OUT)?;
                }
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) if error.kind() == ErrorKind::BrokenPipe => return Err(self.died()),
                Err(error) => return Err(FaultKind::Pipe(error)),
            }
        }
        Ok(())
    }

    /// Reads one length-prefixed body before `deadline`.
    pub(super) fn receive(&mut self, limit: Limit<'_>) -> Result<Vec<u8>, FaultKind> {
        let mut prefix = [0u8; 8];
        self.fill(&mut prefix, limit)?;
        let length = checked_length(prefix).map_err(FaultKind::Nonsense)?;
        // grown as bytes arrive, so that a false length cannot make us allocate
        let mut body = Vec::new();
        while body.len() < length {
            let start = body.len();
            body.resize(length.min(start + (1 << 20)), 0);
            self.fill(&mut body[start..], limit)?;
        }
        Ok(body)
    }

    fn fill(&mut self, target: &mut [u8], limit: Limit<'_>) -> Result<(), FaultKind> {
        let mut filled = 0;
        while filled < target.len() {
            match self.stdout.read(&mut target[filled..]) {
                Ok(0) => return Err(self.died()),
                Ok(read) => filled += read,
                Err(error) if error.kind() == ErrorKind::WouldBlock => {
                    limit.wait(&self.stdout, PollFlags::IN)?;
                }
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) => return Err(FaultKind::Pipe(error)),
            }
        }
        Ok(())
    }

    /// Whether bytes lie in the pipe although nothing was asked.
    pub(super) fn has_unread(&mut self) -> bool {
        let mut fds = [PollFd::new(&self.stdout, PollFlags::IN)];
        let now = Timespec { tv_sec: 0, tv_nsec: 0 };
        poll(&mut fds, Some(&now)).is_ok() && fds[0].revents().contains(PollFlags::IN)
    }

    /// What became of a process whose pipe is closed.
    fn died(&mut self) -> FaultKind {
        let until = Instant::now() + Duration::from_secs(1);
        loop {
            match self.ended() {
                Ok(Some(status)) => return FaultKind::Died(status.to_string()),
                Ok(None) if Instant::now() < until => {
                    std::thread::sleep(Duration::from_millis(5));
                }
                Ok(None) => return FaultKind::Died("its pipe is closed".to_owned()),
                Err(error) => return FaultKind::Pipe(error),
            }
        }
    }

    /// How it ended, if it has. Its children are killed before it is reaped: until then its id is nobody else's.
    fn ended(&mut self) -> std::io::Result<Option<ExitStatus>> {
        if !self.reaped {
            let look = WaitIdOptions::EXITED | WaitIdOptions::NOHANG | WaitIdOptions::NOWAIT;
            if waitid(WaitId::Pid(Pid::from_child(&self.child)), look)?.is_none() {
                return Ok(None);
            }
            self.kill_group();
            self.reaped = true;
        }
        self.child.try_wait()
    }

    fn kill_group(&self) {
        let _ = kill_process_group(Pid::from_child(&self.child), Signal::KILL);
    }

    /// The last lines of its stderr, joined by ` | `.
    pub(super) fn stderr_tail(&self) -> String {
        let Ok(mut file) = File::open(&self.log) else { return String::new() };
        let length = file.metadata().map(|m| m.len()).unwrap_or(0);
        let mut bytes = Vec::new();
        if file.seek(SeekFrom::Start(length.saturating_sub(TAIL_BYTES))).is_err()
            || file.read_to_end(&mut bytes).is_err()
        {
            return String::new();
        }
        let text = String::from_utf8_lossy(&bytes);
        let lines: Vec<&str> = text.lines().filter(|line| !line.trim().is_empty()).collect();
        lines[lines.len().saturating_sub(TAIL_LINES)..].join(" | ")
    }

    /// Closes its stdin and gives it `patience` to end; kills it otherwise.
    pub(super) fn finish(mut self, patience: Duration) {
        self.stdin = None;
        if !self.is_own() {
            return;
        }
        let until = Instant::now() + patience;
        while Instant::now() < until {
            match self.ended() {
                Ok(Some(_)) | Err(_) => return,
                Ok(None) => std::thread::sleep(Duration::from_millis(2)),
            }
        }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        if !self.is_own() || self.reaped {
            return;
        }
        self.kill_group();
        let _ = self.child.wait();
    }
}

/// Starts `command` from a thread that lives as long as this program: the signal that a child asks for
/// when its parent ends comes, on Linux, when the *thread* that started it ends.
fn spawn_for_good(command: Command) -> std::io::Result<Child> {
    type Order = (Command, mpsc::Sender<std::io::Result<Child>>);
    // with the process whose thread it is: a fork has the sender and not the thread
    static STARTER: Mutex<Option<(u32, mpsc::Sender<Order>)>> = Mutex::new(None);
    let starter = {
        let mut starter = STARTER.lock().unwrap_or_else(PoisonError::into_inner);
        match &*starter {
            Some((owner, sender)) if *owner == std::process::id() => sender.clone(),
            _ => {
                let (sender, orders) = mpsc::channel::<Order>();
                let run = move || {
                    for (mut command, answer) in orders {
                        // nobody waiting any more is no reason to end
                        let _ = answer.send(command.spawn());
                    }
                };
                std::thread::Builder::new().name("worker starter".to_owned()).spawn(run)?;
                *starter = Some((std::process::id(), sender.clone()));
                sender
            }
        }
    };
    let gone = |_| std::io::Error::other("the thread that starts workers ended");
    let (answer, answered) = mpsc::channel();
    starter.send((command, answer)).map_err(|_gone| gone(mpsc::RecvError))?;
    answered.recv().map_err(gone)?
}

/// A moment until which one exchange may last.
#[derive(Clone, Copy)]
pub(super) struct Limit<'a> {
    allowed: Duration,
    until: Instant,
    stop: Option<&'a Stop>,
}

/// How often somebody who waits looks whether an end was asked for.
const LOOK: Duration = Duration::from_millis(100);

impl<'a> Limit<'a> {
    /// `allowed` from now on.
    pub(super) fn of(allowed: Duration) -> Self {
        Self { allowed, until: Instant::now() + allowed, stop: None }
    }

    /// Waits no longer than until `stop` is due.
    pub(super) fn unless(self, stop: &'a Stop) -> Self {
        Self { stop: Some(stop), ..self }
    }

    /// Waits until `fd` is ready.
    fn wait(&self, fd: &impl AsFd, flags: PollFlags) -> Result<(), FaultKind> {
        loop {
            let left = self.until.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Err(FaultKind::TimedOut(self.allowed));
            }
            if self.stop.is_some_and(Stop::due) {
                return Err(FaultKind::Stopped);
            }
            let left = if self.stop.is_some() { left.min(LOOK) } else { left };
            let timeout = Timespec {
                tv_sec: i64::try_from(left.as_secs()).unwrap_or(i64::MAX),
                tv_nsec: i64::from(left.subsec_nanos()),
            };
            match poll(&mut [PollFd::new(fd, flags)], Some(&timeout)) {
                Ok(0) | Err(rustix::io::Errno::INTR) => {}
                Ok(_) => return Ok(()),
                Err(error) => return Err(FaultKind::Pipe(error.into())),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn shell(script: &str) -> (tempfile::TempDir, Process) {
        let dir = tempfile::tempdir().unwrap();
        let mut command = Command::new("/bin/sh");
        command.args(["-c", script]);
        let process = Process::spawn(command, &dir.path().join("log"), None).unwrap();
        (dir, process)
    }

    fn within(milliseconds: u64) -> Limit<'static> {
        Limit::of(Duration::from_millis(milliseconds))
    }

    #[test]
    fn what_is_sent_comes_back_from_an_echo() {
        let (_dir, mut process) = shell("exec cat");
        let body: Vec<u8> = (0..3_000_000u32).map(|i| i as u8).collect();
        let mut bytes = (body.len() as u64).to_le_bytes().to_vec();
        bytes.extend(&body);
        // more than a pipe holds: both directions must move at once, so another thread echoes
        std::thread::scope(|scope| {
            let mut stdout = std::process::ChildStdout::from(process.stdout.as_fd().try_clone_to_owned().unwrap());
            let reader = scope.spawn(move || {
                let mut got: Vec<u8> = Vec::new();
                let mut buffer = vec![0; 65536];
                while got.len() < 3_000_008 {
                    match stdout.read(&mut buffer) {
                        Ok(n) => got.extend(&buffer[..n]),
                        Err(_) => std::thread::sleep(Duration::from_millis(1)),
                    }
                }
                got
            });
            process.send(&bytes, within(20_000)).unwrap();
            assert_eq!(reader.join().unwrap(), bytes);
        });
    }

    #[test]
    fn silence_is_a_time_out() {
        let (_dir, mut process) = shell("sleep 60");
        let fault = process.receive(within(50)).unwrap_err();
        assert!(matches!(fault, FaultKind::TimedOut(_)), "{fault}");
    }

    #[test]
    fn a_request_to_stop_ends_waiting() {
        let (_dir, mut process) = shell("sleep 60");
        let begun = Instant::now();
        let stop = Stop::new(std::sync::Arc::new(move || begun.elapsed() > Duration::from_millis(200)));
        let at_once = stop.at_once();
        let fault = process.receive(within(20_000).unless(&at_once)).unwrap_err();
        assert!(matches!(fault, FaultKind::Stopped), "{fault}");
        assert!(begun.elapsed() < Duration::from_secs(1), "{:?}", begun.elapsed());
        // an episode under way has a moment more
        let fault = process.receive(within(20_000).unless(&stop)).unwrap_err();
        assert!(matches!(fault, FaultKind::Stopped), "{fault}");
        assert!(begun.elapsed() > Duration::from_millis(1000), "{:?}", begun.elapsed());
        let never = Stop::never();
        let fault = process.receive(within(50).unless(&never)).unwrap_err();
        assert!(matches!(fault, FaultKind::TimedOut(_)), "{fault}");
    }

    #[test]
    fn an_ended_process_is_reported_with_its_status_and_stderr() {
        let (_dir, mut process) = shell("echo first >&2; echo last words >&2; exit 7");
        let fault = process.receive(within(20_000)).unwrap_err();
        assert!(fault.to_string().contains("exit status: 7"), "{fault}");
        assert_eq!(process.stderr_tail(), "first | last words");
    }

    #[test]
    fn the_children_of_an_ended_process_end_with_it() {
        let (dir, mut process) = shell("sleep 1000 >/dev/null & echo $! >&2; exit 7");
        let fault = process.receive(within(20_000)).unwrap_err();
        assert!(fault.to_string().contains("exit status: 7"), "{fault}");
        let child = std::fs::read_to_string(dir.path().join("log")).unwrap().trim().parse().unwrap();
        let until = Instant::now() + Duration::from_secs(20);
        while alive(child) {
            assert!(Instant::now() < until, "process {child} survived");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    #[test]
    fn a_pipe_that_nobody_reads_is_a_time_out() {
        let (_dir, mut process) = shell("sleep 60");
        let fault = process.send(&vec![0; 1 << 20], within(100)).unwrap_err();
        assert!(matches!(fault, FaultKind::TimedOut(_)), "{fault}");
    }

    #[test]
    fn text_in_the_pipe_is_nonsense() {
        let (_dir, mut process) = shell("echo Welcome to the simulator; sleep 60");
        let fault = process.receive(within(20_000)).unwrap_err();
        assert!(matches!(fault, FaultKind::Nonsense(_)), "{fault}");
        assert!(process.has_unread());
    }

    #[test]
    fn dropping_kills_the_children_too() {
        let (dir, process) = shell("sleep 1000 & echo $! >&2; wait");
        let log = dir.path().join("log");
        let until = Instant::now() + Duration::from_secs(20);
        let child = loop {
            let text = std::fs::read_to_string(&log).unwrap();
            if let Ok(id) = text.trim().parse::<i32>() {
                break id;
            }
            assert!(Instant::now() < until, "the child never reported");
            std::thread::sleep(Duration::from_millis(5));
        };
        drop(process);
        // killed; it may stay a zombie for a moment until init has reaped it
        while alive(child) {
            assert!(Instant::now() < until, "process {child} survived");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    fn alive(id: i32) -> bool {
        std::fs::read_to_string(format!("/proc/{id}/stat"))
            .is_ok_and(|stat| !stat.rsplit(')').next().unwrap_or("").trim_start().starts_with('Z'))
    }
}
