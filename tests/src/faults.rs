//! A program killed, cut short or refused at one of its calls that change files, chosen by number.
//!
//! The program is traced (ptrace), all of its threads and none of its children: whatever reaches the kernel is seen, however
//! it is called. A call counts if it changes something in a given folder: writes, syncs, renames, files and folders
//! made, removed or cut.

#![allow(unsafe_code, reason = "ptrace and waitpid have no safe form")]

use std::collections::HashMap;
use std::fs::{self, File};
use std::io::{Read, Seek};
use std::os::unix::fs::FileExt;
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus};

use libc::{c_int, c_long, c_void, pid_t};

/// What befalls a program.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Action {
    /// SIGKILL before the call has done anything.
    Before,
    /// SIGKILL when it has been done.
    After,
    /// Half of what is to be written is written, then SIGKILL.
    Torn,
    /// This call and every later one that takes room fails: `ENOSPC`.
    Full,
}

/// At which call, counted from 0, and what.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Fault {
    /// Which of the calls.
    pub at: usize,
    /// What happens there.
    pub action: Action,
}

/// A call that changes something in the folder.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Call {
    /// `write`, `rename`, ...
    pub name: &'static str,
    /// What it changes; of a rename the new name.
    pub path: PathBuf,
}

impl Call {
    /// Whether it can be cut in the middle.
    pub fn is_write(&self) -> bool {
        matches!(self.name, "write" | "pwrite64" | "writev")
    }

    /// Whether a full disk refuses it.
    pub fn takes_room(&self) -> bool {
        !matches!(self.name, "unlink" | "rmdir")
    }
}

/// How a traced program ended.
#[derive(Debug)]
pub struct Ended {
    /// Its calls in order.
    pub calls: Vec<Call>,
    /// Its end.
    pub status: ExitStatus,
    /// Standard output.
    pub stdout: String,
    /// Standard error.
    pub stderr: String,
}

/// Runs `command` to its end, with `fault` if there is one; calls count that change something below `folder`.
///
/// # Panics
/// Where it cannot be started or traced.
pub fn run(command: &mut Command, folder: &Path, fault: Option<Fault>) -> Ended {
    let folder = folder.canonicalize().expect("the folder is there");
    let output = || tempfile::tempfile().expect("a temporary file");
    let (mut stdout, mut stderr) = (output(), output());
    command.env_remove("RUST_BACKTRACE").stdin(std::process::Stdio::null());
    command.stdout(stdout.try_clone().expect("another handle")).stderr(stderr.try_clone().expect("another handle"));
    be_traced(command);
    #[allow(clippy::zombie_processes, reason = "the tracer below waits for it")]
    let child = command.spawn().expect("the program starts");
    let pid = pid_t::try_from(child.id()).expect("a process id");
    let mut tracer = Tracer { pid, folder, fault, full: false, calls: Vec::new(), pending: HashMap::new() };
    let status = tracer.follow();
    let text = |file: &mut File| {
        let mut bytes = Vec::new();
        file.rewind().and_then(|()| file.read_to_end(&mut bytes)).expect("readable");
        String::from_utf8_lossy(&bytes).into_owned()
    };
    Ended { calls: tracer.calls, status, stdout: text(&mut stdout), stderr: text(&mut stderr) }
}

/// Lets the program stop for whoever starts it.
fn be_traced(command: &mut Command) {
    // SAFETY: between fork and exec one call of the kernel, which allocates nothing and takes no lock
    unsafe {
        command.pre_exec(|| match ptrace(libc::PTRACE_TRACEME, 0, 0, 0) {
            -1 => Err(std::io::Error::last_os_error()),
            _ => Ok(()),
        });
    }
}

/// Whether programs may be traced here: some sandboxes forbid it. Says so where they may not.
///
/// # Panics
/// In continuous integration (`CI`), where nothing is left out; where `true` cannot be started for another reason.
pub fn allowed() -> bool {
    let mut command = Command::new("true");
    be_traced(&mut command);
    match command.spawn() {
        Ok(mut child) => {
            // it stands at its first instruction
            child.kill().and_then(|()| child.wait()).expect("it ends");
            true
        }
        Err(error) if error.kind() == std::io::ErrorKind::PermissionDenied && std::env::var_os("CI").is_none() => {
            eprintln!("skipped: programs may not be traced here (ptrace: {error})");
            false
        }
        Err(error) => panic!("true: {error}"),
    }
}

/// What is to be done when a thread's call returns.
#[derive(Clone, Copy)]
enum Pending {
    Kill,
    Refuse,
}

struct Tracer {
    pid: pid_t,
    folder: PathBuf,
    fault: Option<Fault>,
    full: bool,
    calls: Vec<Call>,
    /// by thread
    pending: HashMap<pid_t, Pending>,
}

impl Tracer {
    /// From the stop after exec to the end of the process.
    fn follow(&mut self) -> ExitStatus {
        let (first, _) = wait(self.pid);
        assert_eq!(first, self.pid, "the program stops when it begins");
        let options = libc::PTRACE_O_TRACESYSGOOD
            | libc::PTRACE_O_TRACECLONE
            | libc::PTRACE_O_TRACEEXEC
            | libc::PTRACE_O_EXITKILL;
        assert_ne!(ptrace(libc::PTRACE_SETOPTIONS, self.pid, 0, options.into()), -1, "the program can be traced");
        ptrace(libc::PTRACE_SYSCALL, self.pid, 0, 0);
        let mut known = std::collections::HashSet::from([self.pid]);
        loop {
            // this thread's tracees only: other tests have children, too
            let (id, status) = wait(-1);
            if libc::WIFEXITED(status) || libc::WIFSIGNALED(status) {
                if id == self.pid {
                    return ExitStatus::from_raw(status);
                }
                continue;
            }
            let mut signal = 0;
            match libc::WSTOPSIG(status) {
                stopped if stopped == libc::SIGTRAP | 0x80 => self.stopped(id),
                // an event of ptrace itself
                _ if status >> 16 != 0 => {}
                // a new thread begins with this
                libc::SIGSTOP if known.insert(id) => {}
                other => signal = other,
            }
            ptrace(libc::PTRACE_SYSCALL, id, 0, signal.into());
        }
    }

    /// A thread stands before or after a call.
    fn stopped(&mut self, id: pid_t) {
        let mut info = [0_u8; 88];
        if ptrace(libc::PTRACE_GET_SYSCALL_INFO, id, info.len() as c_long, info.as_mut_ptr() as c_long) == -1 {
            return; // killed meanwhile
        }
        let word = |at: usize| u64::from_ne_bytes(info[at..at + 8].try_into().expect("eight bytes"));
        match info[0] {
            libc::PTRACE_SYSCALL_INFO_ENTRY => {
                let arguments: [u64; 6] = std::array::from_fn(|k| word(32 + 8 * k));
                if let Some(call) = self.call(id, word(24) as c_long, &arguments) {
                    self.entered(id, call);
                }
            }
            libc::PTRACE_SYSCALL_INFO_EXIT => match self.pending.remove(&id) {
                Some(Pending::Kill) => self.kill(),
                Some(Pending::Refuse) => registers(id, |registers| registers.rax = (-libc::ENOSPC as i64) as u64),
                None => {}
            },
            _ => {}
        }
    }

    /// A call that counts is about to be made.
    fn entered(&mut self, id: pid_t, call: Call) {
        let hit = self.fault.filter(|fault| fault.at == self.calls.len()).map(|fault| fault.action);
        match hit {
            Some(Action::Before) => self.kill(),
            Some(Action::After) => {
                self.pending.insert(id, Pending::Kill);
            }
            Some(Action::Torn) => {
                registers(id, |registers| registers.rdx /= 2);
                self.pending.insert(id, Pending::Kill);
            }
            Some(Action::Full) => self.full = true,
            None => {}
        }
        if self.full && call.takes_room() {
            // a call that there is not
            registers(id, |registers| registers.orig_rax = u64::MAX);
            self.pending.insert(id, Pending::Refuse);
        }
        self.calls.push(call);
    }

    fn kill(&self) {
        // SAFETY: a signal to a child that was not waited for: the id is still its own
        unsafe { libc::kill(self.pid, libc::SIGKILL) };
    }

    /// The call with this number and these arguments, if it changes something in the folder.
    fn call(&self, id: pid_t, number: c_long, arguments: &[u64; 6]) -> Option<Call> {
        let descriptor = |k: usize| fs::read_link(format!("/proc/{id}/fd/{}", arguments[k] as c_int)).ok();
        let current = || fs::read_link(format!("/proc/{id}/cwd")).ok();
        let plain = |k: usize| Some(current()?.join(text(id, arguments[k])?));
        let at = |k: usize| {
            let base = if arguments[k] as c_int == libc::AT_FDCWD { current() } else { descriptor(k) };
            Some(base?.join(text(id, arguments[k + 1])?))
        };
        // opening makes something only where nothing is
        let makes = |flags: u64, path: PathBuf| {
            (flags as c_int & libc::O_CREAT != 0 && path.symlink_metadata().is_err()).then_some(path)
        };
        let (name, path) = match number {
            libc::SYS_write => ("write", descriptor(0)?),
            libc::SYS_pwrite64 => ("pwrite64", descriptor(0)?),
            libc::SYS_writev => ("writev", descriptor(0)?),
            libc::SYS_fsync => ("fsync", descriptor(0)?),
            libc::SYS_fdatasync => ("fdatasync", descriptor(0)?),
            libc::SYS_ftruncate => ("ftruncate", descriptor(0)?),
            libc::SYS_fallocate => ("fallocate", descriptor(0)?),
            libc::SYS_rename => ("rename", plain(1)?),
            libc::SYS_renameat | libc::SYS_renameat2 => ("rename", at(2)?),
            libc::SYS_link => ("link", plain(1)?),
            libc::SYS_linkat => ("link", at(2)?),
            libc::SYS_mkdir => ("mkdir", plain(0)?),
            libc::SYS_mkdirat => ("mkdir", at(0)?),
            libc::SYS_open => ("create", makes(arguments[1], plain(0)?)?),
            libc::SYS_openat => ("create", makes(arguments[2], at(0)?)?),
            libc::SYS_unlink => ("unlink", plain(0)?),
            libc::SYS_unlinkat => ("unlink", at(0)?),
            libc::SYS_rmdir => ("rmdir", plain(0)?),
            _ => return None,
        };
        path.starts_with(&self.folder).then_some(Call { name, path })
    }
}

/// A text that ends in zero in the memory of a stopped thread.
fn text(id: pid_t, address: u64) -> Option<String> {
    let memory = File::open(format!("/proc/{id}/mem")).ok()?;
    let mut bytes = vec![0_u8; libc::PATH_MAX as usize];
    let read = memory.read_at(&mut bytes, address).ok()?;
    let end = bytes[..read].iter().position(|&byte| byte == 0)?;
    String::from_utf8(bytes[..end].to_vec()).ok()
}

/// Changes the registers of a stopped thread.
fn registers(id: pid_t, change: impl FnOnce(&mut libc::user_regs_struct)) {
    // SAFETY: plain numbers, for which zero is a value
    let mut registers: libc::user_regs_struct = unsafe { std::mem::zeroed() };
    if ptrace(libc::PTRACE_GETREGS, id, 0, &raw mut registers as c_long) != -1 {
        change(&mut registers);
        ptrace(libc::PTRACE_SETREGS, id, 0, &raw mut registers as c_long);
    }
}

/// `ptrace`; addresses are of what lives until it returns.
fn ptrace(request: libc::c_uint, id: pid_t, address: c_long, data: c_long) -> c_long {
    // SAFETY: every request made here reads or writes at `data` no more than what its caller has there
    unsafe { libc::ptrace(request, id, address as *mut c_void, data as *mut c_void) }
}

/// The next thread of `id`, or of all that this thread traces, that stops or ends.
fn wait(id: pid_t) -> (pid_t, c_int) {
    let mut status = 0;
    loop {
        // SAFETY: `status` is written to, and nothing else
        let found = unsafe { libc::waitpid(id, &raw mut status, libc::__WALL | libc::__WNOTHREAD) };
        if found > 0 {
            return (found, status);
        }
        let error = std::io::Error::last_os_error();
        assert_eq!(error.raw_os_error(), Some(libc::EINTR), "waiting for the program: {error}");
    }
}
