//! One worker: one simulator environment in one process, and the requests that it answers.
//!
//! Every answer is checked against the handshake before it is believed. Any method that returns a
//! [`WorkerFault`] leaves the worker unusable: drop it and start another.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::Duration;

use safetensors::Dtype;

use crate::error::{FaultKind, RolloutError, WorkerFault};
use crate::frame::{Frame, FrameTensor};
use crate::message::{Control, EpisodeReply, PROTOCOL, Ready, Reply, Request, Skill};
use crate::process::{Limit, Process};
use crate::recorded::RecordedEpisode;
use crate::spec::{TimeLimits, WorkerSpec};
use crate::stop::Stop;

/// What an environment shows.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Observations {
    /// Numbers by key, flattened row-major.
    values: BTreeMap<String, Vec<f64>>,
    /// Bytes of pictures by key: rows from the top, red, green and blue.
    pictures: BTreeMap<String, Vec<u8>>,
}

impl Observations {
    /// Numbers and the bytes of pictures, by key.
    pub fn new(values: BTreeMap<String, Vec<f64>>, pictures: BTreeMap<String, Vec<u8>>) -> Self {
        Self { values, pictures }
    }

    /// The numbers of a key.
    pub fn get(&self, key: &str) -> Option<&Vec<f64>> {
        self.values.get(key)
    }

    /// All numbers, by key.
    pub fn numbers(&self) -> &BTreeMap<String, Vec<f64>> {
        &self.values
    }

    /// The bytes of a key's picture.
    pub fn picture(&self, key: &str) -> Option<&[u8]> {
        self.pictures.get(key).map(Vec::as_slice)
    }
}

impl<const N: usize> From<[(String, Vec<f64>); N]> for Observations {
    fn from(values: [(String, Vec<f64>); N]) -> Self {
        Self { values: values.into(), pictures: BTreeMap::new() }
    }
}

/// The state that a reset left.
#[derive(Debug, Clone, PartialEq)]
pub struct Initial {
    /// sha256 of the simulator's initial state, in hexadecimal.
    pub fingerprint: String,
    /// The group of episodes that this one belongs to, where the task has groups.
    pub group: Option<String>,
    /// What is to be done, in words, where the environment says so.
    pub instruction: Option<String>,
    /// What the environment shows.
    pub observations: Observations,
    /// How long its pictures took to draw, as the worker says; zero without any.
    pub drawing: Duration,
}

/// What control steps did.
#[derive(Debug, Clone, PartialEq)]
pub struct Stepped {
    /// The reward of each step that was done; the task done or lost ends them early.
    pub rewards: Vec<f64>,
    /// Whether the task is done.
    pub success: bool,
    /// In a word why it can no longer be done, where the environment says so: the episode is over.
    pub failure: Option<String>,
    /// What the environment shows after the last of them.
    pub observations: Observations,
    /// How long its pictures took to draw, as the worker says; zero without any.
    pub drawing: Duration,
    /// Which share of its way the episode has come, of the task's stages and success; `None` where no stages are known.
    pub progress: Option<f64>,
}

/// What a scripted expert did.
#[derive(Debug, Clone, PartialEq)]
pub struct Scripted {
    /// The reward of each step.
    pub rewards: Vec<f64>,
    /// Whether the task was done after each step.
    pub solved: Vec<bool>,
    /// In a word why the task could no longer be done, where that ended the episode.
    pub failure: Option<String>,
    /// Which share of its way the episode came, where stages are known.
    pub progress: Option<f64>,
}

/// An RGB image, row-major from the top.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Image {
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// `height * width * 3` bytes.
    pub rgb: Vec<u8>,
}

/// A running worker.
pub struct Worker {
    process: Process,
    name: String,
    ready: Ready,
    limits: TimeLimits,
    stop: Stop,
    next_id: u64,
}

/// Why a worker did not start: because of this try, or for good.
#[derive(Debug)]
pub(super) enum StartFailure {
    Fault(WorkerFault),
    Final(RolloutError),
}

impl Worker {
    /// Starts a worker and waits for its greeting. `name` is `slot.generation`.
    pub(super) fn start(spec: &WorkerSpec, name: &str, logs: &Path, stop: &Stop) -> Result<Self, StartFailure> {
        let log = logs.join(format!("worker-{name}.stderr"));
        let mut process = Process::spawn(spec.command(), &log, spec.memory_limit).map_err(StartFailure::Final)?;
        let received = process.receive(Limit::of(spec.limits.start).unless(&stop.at_once())).and_then(|body| {
            let frame = Frame::decode(&body).map_err(FaultKind::Nonsense)?;
            frame.parse::<Reply>().map_err(FaultKind::Nonsense)
        });
        let fault = |process: &Process, kind| {
            StartFailure::Fault(WorkerFault {
                worker: name.to_owned(),
                phase: "start",
                kind,
                stderr: process.stderr_tail(),
                log: process.log().to_owned(),
            })
        };
        match received {
            Ok(Reply::Ready(ready)) => {
                check_handshake(&ready, spec).map_err(StartFailure::Final)?;
                let (name, stop, limits) = (name.to_owned(), stop.clone(), spec.limits);
                Ok(Self { process, name, ready: *ready, limits, stop, next_id: 0 })
            }
            Ok(Reply::Error { kind, message, .. }) => {
                let refused = RolloutError::Refused { task: spec.task.clone(), kind: kind.clone(), message };
                let problem = (kind == "missing_module").then(|| spec.python.problem()).flatten();
                Err(StartFailure::Final(problem.unwrap_or(refused)))
            }
            Ok(other) => {
                let kind = unexpected("ready", &other);
                Err(fault(&process, kind))
            }
            Err(FaultKind::Stopped) => Err(StartFailure::Final(RolloutError::Stopped { task: spec.task.clone() })),
            Err(kind @ FaultKind::Died(_)) => match spec.python.problem() {
                Some(problem) => Err(StartFailure::Final(problem)),
                None => Err(fault(&process, kind)),
            },
            Err(kind) => Err(fault(&process, kind)),
        }
    }

    /// What the worker said of itself.
    pub fn ready(&self) -> &Ready {
        &self.ready
    }

    /// Why robosuite's own control loop runs although the compiled one was asked for, if so.
    pub(super) fn fallback(&self, asked: Control) -> Option<String> {
        if asked == self.ready.control || self.ready.control == Control::Own {
            return None;
        }
        // its stderr has little else to say at this point, and says it in one line
        let said = std::fs::read_to_string(self.process.log()).unwrap_or_default();
        let line = said.lines().find(|line| line.contains("compiled control is off"));
        Some(line.unwrap_or("compiled control is off, robosuite's own loop runs").trim().to_owned())
    }

    /// The id of its process, which is also its process group's.
    pub fn process_id(&self) -> u32 {
        self.process.id()
    }

    /// Begins the episode of `seed`.
    ///
    /// # Errors
    /// Any failure of the worker.
    pub fn reset(&mut self, seed: u64) -> Result<Initial, WorkerFault> {
        self.next_id += 1;
        let request = Request::Reset { id: self.next_id, seed };
        let (reply, mut frame) = self.ask(&request, Vec::new(), self.limits.reset)?;
        match reply {
            Reply::Reset { fingerprint, group, ep_meta, drawing_ms, .. } => {
                let observations = self.observations("reset", &mut frame)?;
                let instruction = ep_meta.get("lang").and_then(serde_json::Value::as_str).map(str::to_owned);
                Ok(Initial { fingerprint, group, instruction, observations, drawing: milliseconds(drawing_ms) })
            }
            other => Err(self.fault("reset", unexpected("reset", &other))),
        }
    }

    /// Runs control steps, one an action, until the task is done or lost: one exchange for all that a policy planned.
    ///
    /// # Errors
    /// Any failure of the worker.
    pub fn step(&mut self, actions: &[Vec<f64>]) -> Result<Stepped, WorkerFault> {
        self.next_id += 1;
        let request = Request::Step { id: self.next_id };
        let shape = [actions.len(), actions.first().map_or(0, Vec::len)];
        let tensors = vec![("action", FrameTensor::from_f64(&shape, &actions.concat()))];
        let (reply, mut frame) = self.ask(&request, tensors, self.limits.step)?;
        match reply {
            Reply::Step { success, failure, drawing_ms, progress, .. } => {
                let progress = share(progress).map_err(|kind| self.fault("step", kind))?;
                let over = success || failure.is_some();
                let rewards = self.rewards(&frame, actions.len(), over).map_err(|kind| self.fault("step", kind))?;
                let observations = self.observations("step", &mut frame)?;
                Ok(Stepped { rewards, success, failure, observations, drawing: milliseconds(drawing_ms), progress })
            }
            other => Err(self.fault("step", unexpected("step", &other))),
        }
    }

    /// The rewards of a step's answer: one for each action, fewer only where the episode was over before the last.
    fn rewards(&self, frame: &Frame, actions: usize, over: bool) -> Result<Vec<f64>, FaultKind> {
        let rewards =
            frame.tensor("rewards").and_then(|tensor| tensor.to_f64("rewards")).map_err(FaultKind::Nonsense)?;
        let done = rewards.len();
        if done == 0 || done > actions || (done < actions && !over) {
            return Err(FaultKind::Values(format!("rewards: expected {actions} values, found {done}")));
        }
        numbers(&rewards)?;
        Ok(rewards)
    }

    /// Runs a whole scripted episode, to be learned from; `expert` is another of the task's experts than the usual one,
    /// `skill` says how able whoever shows it is.
    ///
    /// # Errors
    /// Any failure of the worker.
    pub fn expert(&mut self, seed: u64, expert: Option<&str>, skill: Skill) -> Result<RecordedEpisode, WorkerFault> {
        self.scripted(seed, "demonstration", expert, skill).map(|(episode, ..)| episode)
    }

    /// Runs the scripted expert in the episode that an evaluation of `seed` begins with.
    ///
    /// # Errors
    /// Any failure of the worker.
    pub fn expert_evaluated(&mut self, seed: u64) -> Result<Scripted, WorkerFault> {
        let (episode, failure, progress) = self.scripted(seed, "evaluation", None, Skill::Good)?;
        let read = |name: &str| {
            let tensor = episode.tensors.get(name).ok_or_else(|| format!("no array {name:?} in the episode"))?;
            Ok((tensor, name.to_owned()))
        };
        let fault = |what: String| self.fault("expert", FaultKind::Values(what));
        let (rewards, name) = read("rewards").map_err(fault)?;
        let rewards = rewards.to_f64(&name).map_err(|error| self.fault("expert", FaultKind::Nonsense(error)))?;
        numbers(&rewards).map_err(|kind| self.fault("expert", kind))?;
        let (dones, name) = read("dones").map_err(fault)?;
        let mut solved = dones.to_i64(&name).map_err(|error| self.fault("expert", FaultKind::Nonsense(error)))?;
        // in robomimic's arrays the last step is done in any case
        if let Some(last) = solved.last_mut() {
            *last = i64::from(episode.success);
        }
        let solved = solved.into_iter().map(|done| done != 0).collect();
        Ok(Scripted { rewards, solved, failure, progress })
    }

    /// The episode, why it was lost and how far it came.
    fn scripted(
        &mut self,
        seed: u64,
        split: &str,
        expert: Option<&str>,
        skill: Skill,
    ) -> Result<(RecordedEpisode, Option<String>, Option<f64>), WorkerFault> {
        self.next_id += 1;
        let request = Request::Expert { id: self.next_id, seed, split, expert, skill };
        let (reply, frame) = self.ask(&request, Vec::new(), self.limits.episode)?;
        match reply {
            Reply::Expert(mut reply) => {
                let progress = share(reply.progress).map_err(|kind| self.fault("expert", kind))?;
                let failure = reply.failure.take();
                Ok((self.recorded("expert", reply, frame)?, failure, progress))
            }
            other => Err(self.fault("expert", unexpected("expert", &other))),
        }
    }

    /// Replays stored states and returns what the environment shows along them. `ep_meta` is the demonstration's
    /// attribute of that name, an object: what an environment has to know of an episode beyond its states.
    ///
    /// # Errors
    /// Any failure of the worker.
    pub fn extract(
        &mut self,
        model_file: &str,
        ep_meta: &serde_json::Value,
        states: FrameTensor,
        actions: FrameTensor,
    ) -> Result<RecordedEpisode, WorkerFault> {
        self.next_id += 1;
        let request = Request::Extract { id: self.next_id, model_file, ep_meta };
        let tensors = vec![("states", states), ("actions", actions)];
        let (reply, frame) = self.ask(&request, tensors, self.limits.episode)?;
        match reply {
            Reply::Extract(reply) => self.recorded("extract", reply, frame),
            other => Err(self.fault("extract", unexpected("extract", &other))),
        }
    }

    /// Renders the present state.
    ///
    /// # Errors
    /// Any failure of the worker.
    pub fn render(&mut self, camera: &str, height: usize, width: usize) -> Result<Image, WorkerFault> {
        self.next_id += 1;
        let request = Request::Render { id: self.next_id, camera, size: [height, width] };
        let (reply, mut frame) = self.ask(&request, Vec::new(), self.limits.step)?;
        if !matches!(reply, Reply::Render { .. }) {
            return Err(self.fault("render", unexpected("render", &reply)));
        }
        match frame.tensors.remove("image") {
            Some(image) if image.dtype == Dtype::U8 && image.shape == [height, width, 3] => {
                Ok(Image { height, width, rgb: image.bytes })
            }
            other => {
                let found = other.map_or("none".to_owned(), |t| format!("{:?}{:?}", t.dtype, t.shape));
                let what = format!("image: expected U8[{height}, {width}, 3], found {found}");
                Err(self.fault("render", FaultKind::Values(what)))
            }
        }
    }

    /// Checks that nothing is left in the pipe: the last answers were the whole of what it wrote.
    ///
    /// # Errors
    /// Bytes that nobody asked for.
    pub fn check_quiet(&mut self) -> Result<(), WorkerFault> {
        if self.process.has_unread() {
            return Err(self.fault("end of episode", FaultKind::Unasked));
        }
        Ok(())
    }

    /// Asks the worker to end and waits for it, a moment.
    pub fn close(mut self) {
        if !self.process.is_own() {
            return;
        }
        self.next_id += 1;
        let request = Request::Close { id: self.next_id };
        let _ = self.ask(&request, Vec::new(), Duration::from_secs(2));
        self.process.finish(Duration::from_secs(2));
    }

    fn ask(
        &mut self,
        request: &Request<'_>,
        tensors: Vec<(&str, FrameTensor)>,
        allowed: Duration,
    ) -> Result<(Reply, Frame), WorkerFault> {
        let phase = request.name();
        let exchanged = self.exchange(request, tensors, allowed);
        let (reply, frame) = exchanged.map_err(|fault| self.fault(phase, fault))?;
        if let Reply::Error { kind, message, .. } = reply {
            let fault = match kind == "environment" {
                true => FaultKind::Environment(message),
                false => FaultKind::Reported { kind, message },
            };
            return Err(self.fault(phase, fault));
        }
        Ok((reply, frame))
    }

    fn exchange(
        &mut self,
        request: &Request<'_>,
        tensors: Vec<(&str, FrameTensor)>,
        allowed: Duration,
    ) -> Result<(Reply, Frame), FaultKind> {
        if !self.process.is_own() {
            return Err(FaultKind::Foreign);
        }
        if self.process.has_unread() {
            // either it died, or it wrote without being asked: reading tells which
            return Err(match self.process.receive(Limit::of(Duration::from_secs(1))) {
                Err(fault @ FaultKind::Died(_)) => fault,
                _ => FaultKind::Unasked,
            });
        }
        let mut frame = Frame::new(request).map_err(FaultKind::Nonsense)?;
        for (name, tensor) in tensors {
            frame.tensors.insert(name.to_owned(), tensor);
        }
        let limit = Limit::of(allowed).unless(&self.stop);
        let bytes = frame.encode().map_err(FaultKind::Nonsense)?;
        self.process.send(&bytes, limit)?;
        let body = self.process.receive(limit)?;
        let frame = Frame::decode(&body).map_err(FaultKind::Nonsense)?;
        let reply: Reply = frame.parse().map_err(FaultKind::Nonsense)?;
        match reply.answers() {
            ("error" | "closed", None) => {}
            (_, id) if id == Some(self.next_id) => {}
            (name, id) => {
                return Err(FaultKind::Unexpected {
                    expected: format!("an answer to request {}", self.next_id),
                    found: format!("{name} to {id:?}"),
                });
            }
        }
        Ok((reply, frame))
    }

    /// Takes the observations out of a reply; pictures are moved, not copied.
    fn observations(&self, phase: &'static str, frame: &mut Frame) -> Result<Observations, WorkerFault> {
        let mut observations = Observations::default();
        for (key, shape) in &self.ready.observations {
            let name = format!("obs/{key}");
            let values = frame
                .tensor(&name)
                .map_err(FaultKind::Nonsense)
                .and_then(|tensor| {
                    if tensor.shape != *shape {
                        let found = &tensor.shape;
                        return Err(FaultKind::Values(format!("{name}: expected shape {shape:?}, found {found:?}")));
                    }
                    if tensor.dtype == Dtype::U8 {
                        return Ok(None);
                    }
                    tensor.to_f64(&name).map(Some).map_err(FaultKind::Nonsense)
                })
                .map_err(|kind| self.fault(phase, kind))?;
            let Some(values) = values else {
                let picture = frame.tensors.remove(&name).map(|tensor| tensor.bytes);
                observations.pictures.insert(key.clone(), picture.unwrap_or_default());
                continue;
            };
            if let Some(at) = values.iter().position(|value| !value.is_finite()) {
                let what = format!("the environment's observation {name}[{at}] is {}", values[at]);
                return Err(self.fault(phase, FaultKind::Environment(what)));
            }
            observations.values.insert(key.clone(), values);
        }
        Ok(observations)
    }

    fn recorded(&self, phase: &'static str, reply: EpisodeReply, frame: Frame) -> Result<RecordedEpisode, WorkerFault> {
        let values = |what: String| self.fault(phase, FaultKind::Values(what));
        let rows = |name: &str| match frame.tensors.get(name) {
            Some(tensor) if !tensor.shape.is_empty() => Ok(tensor.shape[0]),
            _ => Err(values(format!("no array {name:?} in the episode"))),
        };
        let steps = rows("actions")?;
        if let Some(said) = reply.steps.filter(|said| *said != steps) {
            return Err(values(format!("it says {said} steps and sends {steps} actions")));
        }
        for name in frame.tensors.keys() {
            let found = rows(name)?;
            if found != steps {
                return Err(values(format!("{name}: expected {steps} rows, found {found}")));
            }
        }
        Ok(RecordedEpisode { success: reply.success, steps, attrs: reply.attrs, tensors: frame.tensors })
    }

    fn fault(&self, phase: &'static str, kind: FaultKind) -> WorkerFault {
        WorkerFault {
            worker: self.name.clone(),
            phase,
            kind,
            stderr: self.process.stderr_tail(),
            log: self.process.log().to_owned(),
        }
    }
}

/// Rewards have to be numbers.
fn numbers(rewards: &[f64]) -> Result<(), FaultKind> {
    match rewards.iter().find(|reward| !reward.is_finite()) {
        Some(reward) => Err(FaultKind::Environment(format!("the environment's reward is {reward}"))),
        None => Ok(()),
    }
}

/// A share that a worker reports: from 0 to 1, if it is one.
fn share(reported: Option<f64>) -> Result<Option<f64>, FaultKind> {
    match reported {
        Some(share) if !(0.0..=1.0).contains(&share) => Err(FaultKind::Values(format!("progress {share}"))),
        share => Ok(share),
    }
}

/// A duration that a worker reports; nonsense is no time.
fn milliseconds(reported: f64) -> Duration {
    Duration::try_from_secs_f64(reported / 1e3).unwrap_or_default()
}

fn unexpected(expected: &str, found: &Reply) -> FaultKind {
    FaultKind::Unexpected { expected: expected.to_owned(), found: found.answers().0.to_owned() }
}

fn check_handshake(ready: &Ready, spec: &WorkerSpec) -> Result<(), RolloutError> {
    let differs = |what, expected: &dyn std::fmt::Display, found: &dyn std::fmt::Display| {
        Err(RolloutError::Handshake { what, expected: expected.to_string(), found: found.to_string() })
    };
    if ready.protocol != PROTOCOL {
        return differs("protocol version", &PROTOCOL, &ready.protocol);
    }
    if ready.task != spec.task {
        return differs("task", &spec.task, &ready.task);
    }
    if ready.action_dim == 0 {
        return differs("action_dim", &"at least 1", &0);
    }
    for (what, bounds) in [("action_low", &ready.action_low), ("action_high", &ready.action_high)] {
        if bounds.len() != ready.action_dim {
            return differs(what, &format!("{} values", ready.action_dim), &bounds.len());
        }
    }
    for (low, high) in ready.action_low.iter().zip(&ready.action_high) {
        if low.is_nan() || high.is_nan() || low >= high {
            return differs("action limits", &"low below high", &format!("{low} and {high}"));
        }
    }
    if ready.observations.is_empty() {
        return differs("observations", &"at least one", &"none");
    }
    if ready.max_steps == 0 {
        return differs("max_steps", &"at least 1", &0);
    }
    Ok(())
}
