//! A policy that a server runs.

use std::io::{self, ErrorKind, Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::thread;
use std::time::{Duration, Instant};

use models::{ActionChunk, ModelError, Observation, Policy, Signature};
use tungstenite::client::IntoClientRequest;
use tungstenite::http::{HeaderValue, Uri};
use tungstenite::protocol::WebSocketConfig;
use tungstenite::{Error, HandshakeError, Message, WebSocket};

use crate::codec::{Value, decode, encode, shown};
use crate::error::{Result, ServingError};
use crate::mapping::{INSTRUCTION, Mapped, Mapping};
use crate::session::{EPISODE_KEYS, EXECUTED, RESET, SEED, integer};

/// Bytes of an answer.
const MOST_ANSWER: usize = 64 << 20;
/// Actions of a chunk.
const MOST_HORIZON: usize = 100_000;
/// Reconnection attempts; the pause before each doubles.
const ATTEMPTS: u32 = 3;

/// A policy that a server runs, for one environment, over a connection of its own.
///
/// After a lost connection it reconnects. If the server keeps state within an episode, the episode's queries are sent again, so
/// that the outcome stays the same.
#[derive(Debug)]
pub struct RemotePolicy {
    address: Address,
    /// before the first reconnection
    pub(crate) pause: Duration,
    /// the text under the key `prompt`, with `{instruction}` in it
    prompt: Option<String>,
    task: String,
    /// what is to be done in the episode, where its environment says it
    instruction: Option<String>,
    items: Vec<Mapped>,
    action_dim: usize,
    /// what the server said of itself
    server: Facts,
    connection: Option<Connection>,
    /// the queries of this episode, where the server keeps its state
    episode: Vec<Vec<u8>>,
    /// of an episode that has not begun yet
    seed: Option<u64>,
    executed: usize,
    before: Vec<Observation>,
}

type Connection = WebSocket<Timed>;

/// How long a goodbye may take.
const GOODBYE: Duration = Duration::from_secs(1);

impl Drop for RemotePolicy {
    /// Closes the connection as the protocol has it, so that the server does not take the end for a fault.
    fn drop(&mut self) {
        if let Some(mut socket) = self.connection.take() {
            socket.get_mut().until = Instant::now() + GOODBYE;
            let _ = socket.close(None); // a server that has gone needs none
        }
    }
}

/// What a server's metadata says, as far as we read it.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Facts {
    /// The entry that is served.
    pub entry: Option<String>,
    /// The simulator's keys of each feature.
    pub observation_keys: Vec<(String, Vec<String>)>,
    /// Shapes of observations by key.
    pub shapes: Vec<(String, Vec<usize>)>,
    /// Length of an action.
    pub action_dim: Option<usize>,
    /// Actions of a chunk that are executed.
    pub n_action_steps: Option<usize>,
    /// Coefficient of the temporal ensemble that its actions are executed with.
    pub temporal_ensemble: Option<f64>,
    /// Conventions of the policy, by name.
    pub conventions: std::collections::BTreeMap<String, String>,
    /// Actions of a chunk.
    pub action_horizon: Option<usize>,
    /// Observations that the policy reads at once.
    n_obs_steps: usize,
    /// Whether the server keeps the state of an episode, and is told of its beginning.
    keeps_episodes: bool,
    max_message: Option<usize>,
}

impl Facts {
    /// Asks a server what it is.
    ///
    /// # Errors
    /// A server that is not there or speaks another language.
    pub fn ask(address: &str, token: Option<&str>, mapping: &Mapping) -> Result<Self> {
        let server = Address { url: address.to_owned(), token: token.map(str::to_owned), timeout: mapping.timeout() };
        server.open().map(|(_, facts)| facts).map_err(|failure| server.failed(failure))
    }

    /// The error of a server whose metadata changed.
    fn changed(&self, now: &Self) -> String {
        let name = |facts: &Self| facts.entry.clone().unwrap_or_else(|| "a policy without a name".to_owned());
        match (name(self), name(now)) {
            (was, is) if was != is => {
                format!("the server now runs {is}, expected {was}; evaluate it under another name")
            }
            (was, _) => format!("the server reports other metadata for {was} than before; run the evaluation again"),
        }
    }

    fn of(metadata: &Value<'_>) -> Result<Self> {
        let Value::Map(_) = metadata else {
            return Err(ServingError::message("message", "a map", metadata.to_string()));
        };
        let count = |key: &str| -> Result<Option<usize>> {
            match metadata.get(key) {
                None | Some(Value::Nil) => Ok(None),
                Some(value) => match value.count().and_then(|count| usize::try_from(count).ok()) {
                    Some(count) if count > 0 => Ok(Some(count)),
                    _ => Err(ServingError::message(key, "an integer from 1 on", value.to_string())),
                },
            }
        };
        let n_obs_steps = count("n_obs_steps")?.unwrap_or(1);
        if n_obs_steps > 1000 {
            return Err(ServingError::message("n_obs_steps", "at most 1000", n_obs_steps.to_string()));
        }
        let listed = |key: &str| match metadata.get(key) {
            Some(Value::List(values)) => values.clone(),
            _ => Vec::new(),
        };
        let keys = listed(EPISODE_KEYS);
        let text = |value: &Value<'_>| match value {
            Value::Text(text) => Some(text.to_string()),
            _ => None,
        };
        Ok(Self {
            entry: metadata.get("entry").and_then(text),
            observation_keys: lists(metadata.get("observation_keys"), Some, text),
            shapes: lists(
                metadata.get("observation"),
                |value| value.get("shape"),
                |extent| extent.count().and_then(|extent| usize::try_from(extent).ok()),
            ),
            action_dim: count("action_dim")?,
            n_action_steps: count("n_action_steps")?,
            temporal_ensemble: match metadata.get("temporal_ensemble") {
                Some(Value::Float(coefficient)) => Some(*coefficient),
                _ => None,
            },
            conventions: match metadata.get("conventions") {
                Some(Value::Map(pairs)) => {
                    pairs.iter().filter_map(|(name, value)| Some((name.to_string(), text(value)?))).collect()
                }
                _ => std::collections::BTreeMap::new(),
            },
            action_horizon: count("action_horizon")?,
            n_obs_steps,
            keeps_episodes: [RESET, SEED, EXECUTED].iter().all(|key| keys.contains(&Value::text(*key))),
            max_message: count("max_message_bytes")?,
        })
    }

    /// Compares them with what is sent and expected.
    fn check(&self, items: &[Mapped], action_dim: usize) -> Result<()> {
        for (key, shape) in &self.shapes {
            let Some(mapped) = items.iter().find(|mapped| mapped.item.key == *key) else {
                let sent: Vec<&str> = items.iter().map(|mapped| mapped.item.key.as_str()).collect();
                return Err(ServingError::message(shown(key), "a key that is sent", sent.join(", ")));
            };
            if *shape != mapped.shape() {
                let expected = format!("{:?}, which is sent", mapped.shape());
                return Err(ServingError::message(shown(key), expected, format!("{shape:?}")));
            }
        }
        match self.action_dim.filter(|dim| *dim != action_dim) {
            Some(dim) => Err(ServingError::message("action_dim", action_dim.to_string(), dim.to_string())),
            None => Ok(()),
        }
    }
}

/// The lists of a map of lists, by key; what is none is left out.
fn lists<'v, 'm, T>(
    map: Option<&'v Value<'m>>,
    list: impl Fn(&'v Value<'m>) -> Option<&'v Value<'m>>,
    element: impl Fn(&Value<'m>) -> Option<T>,
) -> Vec<(String, Vec<T>)> {
    let Some(Value::Map(pairs)) = map else { return Vec::new() };
    let one = |(key, value): &'v (std::borrow::Cow<'m, str>, Value<'m>)| match list(value)? {
        Value::List(values) => Some((key.to_string(), values.iter().map(&element).collect::<Option<Vec<T>>>()?)),
        _ => None,
    };
    pairs.iter().filter_map(one).collect()
}

/// A server and how long it may take.
#[derive(Debug, Clone)]
struct Address {
    url: String,
    token: Option<String>,
    timeout: Duration,
}

/// Why there is no answer.
enum Failure {
    /// The connection is gone; another one may do.
    Lost(String),
    /// Nothing that another connection would change.
    Final(String),
}

impl RemotePolicy {
    /// Connects to `ws://host:port` and compares what the server says with what it will be sent: the features of `signature`
    /// under the names of `mapping`.
    ///
    /// # Errors
    /// A server that is not there or speaks another language; observations or actions of another shape, by name.
    pub fn connect(address: &str, token: Option<&str>, signature: &Signature, mapping: &Mapping) -> Result<Self> {
        let items = mapping.items(signature)?;
        let address = Address { url: address.to_owned(), token: token.map(str::to_owned), timeout: mapping.timeout() };
        let (connection, server) = address.open().map_err(|failure| address.failed(failure))?;
        server
            .check(&items, signature.action_dim)
            .map_err(|error| address.failed(Failure::Final(format!("its metadata: {error}"))))?;
        Ok(Self {
            address,
            pause: Duration::from_secs(1),
            prompt: mapping.prompt.clone(),
            task: mapping.task.clone(),
            instruction: None,
            items,
            action_dim: signature.action_dim,
            server,
            connection: Some(connection),
            episode: Vec::new(),
            seed: Some(0),
            executed: 0,
            before: Vec::new(),
        })
    }
}

impl RemotePolicy {
    /// The same policy, if the server reports the same metadata as before.
    ///
    /// # Errors
    /// Another entry or other settings.
    pub fn as_asked(self, before: &Facts) -> Result<Self> {
        if self.server == *before { Ok(self) } else { Err(self.failed(before.changed(&self.server))) }
    }
}

impl Address {
    fn failed(&self, failure: Failure) -> ServingError {
        let (Failure::Lost(detail) | Failure::Final(detail)) = failure;
        ServingError::Server { address: self.url.clone(), detail }
    }

    /// A connection whose metadata was read.
    fn open(&self) -> std::result::Result<(Connection, Facts), Failure> {
        let uri: Uri = self.url.parse().map_err(|error| Failure::Final(format!("no address: {error}")))?;
        let (Some("ws"), Some(host)) = (uri.scheme_str(), uri.host()) else {
            return Err(Failure::Final("expected ws://host:port".to_owned()));
        };
        let until = Instant::now() + self.timeout;
        let host = host.trim_start_matches('[').trim_end_matches(']');
        let lost = |error: io::Error| Failure::Lost(format!("cannot connect: {error}"));
        let mut result = Err(lost(ErrorKind::NotFound.into()));
        for address in (host, uri.port_u16().unwrap_or(80)).to_socket_addrs().map_err(lost)? {
            result = TcpStream::connect_timeout(&address, self.timeout).map_err(lost);
            if result.is_ok() {
                break;
            }
        }
        let stream = result?;
        stream.set_nodelay(true).map_err(lost)?;
        let mut request = uri.into_client_request().map_err(|error| Failure::Final(error.to_string()))?;
        if let Some(token) = &self.token {
            let value = HeaderValue::from_str(&format!("Api-Key {token}"));
            let value = value.map_err(|error| Failure::Final(format!("token: {error}")))?;
            request.headers_mut().insert("Authorization", value);
        }
        let config = WebSocketConfig::default().max_message_size(Some(MOST_ANSWER)).max_frame_size(Some(MOST_ANSWER));
        let stream = Timed { stream, until };
        let (mut connection, _) =
            tungstenite::client::client_with_config(request, stream, Some(config)).map_err(|error| match error {
                HandshakeError::Failure(Error::Http(response)) => {
                    let text = response.body().as_deref().map(String::from_utf8_lossy).unwrap_or_default();
                    let text: String = shown(text.trim());
                    Failure::Final(format!("refused with {}: {text}", response.status()))
                }
                HandshakeError::Failure(error) => self.failure(error, "opening a WebSocket"),
                HandshakeError::Interrupted(_) => self.failure(timed_out(), "opening a WebSocket"),
            })?;
        let metadata = self.receive(&mut connection, "its metadata")?;
        let facts = decode(&metadata).and_then(|metadata| Facts::of(&metadata));
        Ok((connection, facts.map_err(|error| Failure::Final(format!("its metadata: {error}")))?))
    }

    /// The next binary message.
    fn receive(&self, connection: &mut Connection, what: &str) -> std::result::Result<Vec<u8>, Failure> {
        loop {
            match connection.read() {
                Ok(Message::Binary(bytes)) => return Ok(bytes.into()),
                Ok(Message::Text(text)) => {
                    // of a traceback the last line says what it was
                    let last = text.lines().rev().find(|line| !line.trim().is_empty()).unwrap_or("an empty text");
                    let last: String = last.chars().filter(|c| !c.is_control()).take(500).collect();
                    return Err(Failure::Final(format!("it answered with an error: {last}")));
                }
                Ok(_) => {}
                Err(error) => return Err(self.failure(error, what)),
            }
        }
    }

    fn failure(&self, error: Error, what: &str) -> Failure {
        match error {
            Error::Io(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {
                Failure::Final(format!("no answer within {} s ({what})", self.timeout.as_secs_f32()))
            }
            Error::Io(error) => Failure::Lost(format!("the connection was lost ({what}): {error}")),
            Error::ConnectionClosed | Error::AlreadyClosed => {
                Failure::Lost(format!("it closed the connection ({what})"))
            }
            Error::Protocol(
                tungstenite::error::ProtocolError::ResetWithoutClosingHandshake
                | tungstenite::error::ProtocolError::HandshakeIncomplete,
            ) => Failure::Lost(format!("the connection was lost ({what})")),
            Error::Capacity(error) => {
                Failure::Final(format!("its answer is too large, expected at most {MOST_ANSWER} bytes: {error}"))
            }
            other => Failure::Final(format!("no WebSocket messages ({what}): {other}")),
        }
    }

    fn exchange(&self, connection: &mut Connection, query: &[u8]) -> std::result::Result<Vec<u8>, Failure> {
        connection.get_mut().until = Instant::now() + self.timeout;
        let what = "a query";
        connection.send(Message::binary(query.to_vec())).map_err(|error| self.failure(error, what))?;
        self.receive(connection, what)
    }
}

impl RemotePolicy {
    fn failed(&self, detail: String) -> ServingError {
        self.address.failed(Failure::Final(detail))
    }

    /// The answer to a query, over another connection if that is lost.
    fn ask(&mut self, query: &[u8]) -> Result<Vec<u8>> {
        let mut attempts = 0;
        loop {
            let failure = match self.connected().and_then(|mut connection| {
                let answer = self.address.exchange(&mut connection, query)?;
                self.connection = Some(connection);
                Ok(answer)
            }) {
                Ok(answer) => return Ok(answer),
                Err(failure) => failure,
            };
            match failure {
                Failure::Final(detail) => return Err(self.failed(detail)),
                Failure::Lost(detail) if attempts == ATTEMPTS => {
                    return Err(self.failed(format!("{detail}; tried {} times", attempts + 1)));
                }
                Failure::Lost(_) => {
                    thread::sleep(self.pause * (1 << attempts));
                    attempts += 1;
                }
            }
        }
    }

    /// The connection, or another one at the same place of the episode.
    fn connected(&mut self) -> std::result::Result<Connection, Failure> {
        if let Some(connection) = self.connection.take() {
            return Ok(connection);
        }
        let (mut connection, now) = self.address.open()?;
        if now != self.server {
            return Err(Failure::Final(self.server.changed(&now)));
        }
        for query in &self.episode {
            self.address.exchange(&mut connection, query)?;
        }
        Ok(connection)
    }

    fn query(&mut self, observation: &Observation) -> Result<ActionChunk> {
        let stacked = self.server.n_obs_steps > 1;
        let seen: Vec<&Observation> = self.before.iter().chain([observation]).collect();
        let mut pairs = Vec::new();
        for mapped in &self.items {
            pairs.push((mapped.item.key.clone(), mapped.value(&seen, stacked)?));
        }
        if let Some(prompt) = &self.prompt {
            let prompt = prompt.replace(INSTRUCTION, self.instruction.as_deref().unwrap_or(&self.task));
            pairs.push(("prompt".to_owned(), Value::text(prompt)));
        }
        if self.server.keeps_episodes {
            match self.seed {
                Some(seed) => {
                    pairs.push((RESET.to_owned(), Value::Bool(true)));
                    pairs.push((SEED.to_owned(), Value::Integer(seed.into())));
                }
                None => pairs.push((EXECUTED.to_owned(), integer(self.executed))),
            }
        }
        let query = encode(&Value::map(pairs));
        if let Some(most) = self.server.max_message.filter(|most| query.len() > *most) {
            let detail =
                format!("an observation has {} bytes, expected at most {most}, as the server says", query.len());
            return Err(self.failed(detail));
        }
        let answer = self.ask(&query)?;
        let chunk = chunk(&answer, self.action_dim).map_err(|error| self.failed(format!("its answer: {error}")))?;
        if self.server.keeps_episodes {
            self.episode.push(query);
        }
        (self.seed, self.executed) = (None, 0);
        self.before.clear();
        Ok(chunk)
    }
}

/// The actions of an answer: (T, A).
fn chunk(answer: &[u8], action_dim: usize) -> Result<ActionChunk> {
    let answer = decode(answer)?;
    let wanted = || format!("an array of numbers (T, {action_dim})");
    let Some(actions) = answer.get("actions") else {
        return Err(ServingError::message("actions", wanted(), format!("no such key in {answer}")));
    };
    let wrong = |found: String| ServingError::message("actions", wanted(), found);
    let array = actions.to_array().ok_or_else(|| wrong(actions.to_string()))?;
    let &[horizon, width] = array.shape() else { return Err(wrong(actions.to_string())) };
    if width != action_dim || !(1..=MOST_HORIZON).contains(&horizon) {
        return Err(wrong(actions.to_string()));
    }
    let numbers = array.numbers();
    if let Some(at) = numbers.iter().position(|number| !number.is_finite()) {
        return Err(ServingError::message(
            "actions",
            "finite numbers",
            format!("{} in action {}", numbers[at], at / width),
        ));
    }
    Ok(ActionChunk::new(numbers, horizon, width)?)
}

impl Policy for RemotePolicy {
    fn predict(&mut self, observation: &Observation) -> std::result::Result<ActionChunk, ModelError> {
        self.query(observation).map_err(|error| match error {
            ServingError::Message { .. } => self.failed(error.to_string()).into(),
            other => other.into(),
        })
    }

    fn n_obs_steps(&self) -> usize {
        self.server.n_obs_steps
    }

    fn observe(&mut self, observation: &Observation) {
        if self.server.n_obs_steps > 1 {
            if self.before.len() + 1 == self.server.n_obs_steps {
                self.before.remove(0);
            }
            self.before.push(observation.clone());
        }
    }

    fn executed(&mut self, actions: usize) {
        self.executed += actions;
    }

    fn reset(&mut self, seed: u64) {
        self.episode.clear();
        self.before.clear();
        (self.seed, self.executed) = (Some(seed), 0);
        self.instruction = None;
    }

    fn instruct(&mut self, instruction: Option<&str>) {
        self.instruction = instruction.map(str::to_owned);
    }
}

fn timed_out() -> Error {
    Error::Io(ErrorKind::TimedOut.into())
}

/// A stream on which reading and writing end at a moment, however slowly the other side goes on.
#[derive(Debug)]
struct Timed {
    stream: TcpStream,
    until: Instant,
}

impl Timed {
    fn left(&self) -> io::Result<Option<Duration>> {
        let left = self.until.saturating_duration_since(Instant::now());
        if left.is_zero() { Err(ErrorKind::TimedOut.into()) } else { Ok(Some(left)) }
    }
}

impl Read for Timed {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        self.stream.set_read_timeout(self.left()?)?;
        self.stream.read(buffer)
    }
}

impl Write for Timed {
    fn write(&mut self, buffer: &[u8]) -> io::Result<usize> {
        self.stream.set_write_timeout(self.left()?)?;
        self.stream.write(buffer)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.stream.flush()
    }
}
