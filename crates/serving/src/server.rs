//! openpi's and vla-eval's protocol, as a server: a thread a client, health and metrics on the same port.

use std::collections::BTreeMap;
use std::io::{self, ErrorKind, Read, Write};
use std::net::{Shutdown, SocketAddr, TcpListener, TcpStream, ToSocketAddrs};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

use tungstenite::error::CapacityError;
use tungstenite::handshake::derive_accept_key;
use tungstenite::protocol::frame::CloseFrame;
use tungstenite::protocol::frame::coding::CloseCode;
use tungstenite::protocol::{Role, WebSocketConfig};
use tungstenite::{Message, WebSocket};

use crate::codec::encode;
use crate::error::{Result, ServingError};
use crate::session::{Service, Session};
use crate::vla_eval;

/// What a server takes at most.
#[derive(Debug, Clone, Copy)]
pub struct Limits {
    /// Clients at once.
    pub clients: usize,
    /// Bytes of an observation.
    pub message: usize,
}

impl Default for Limits {
    fn default() -> Self {
        Self { clients: 64, message: 32 << 20 }
    }
}

/// Connections that may wait for an answer to a health check, or to hear that there are too many clients.
const FURTHER: usize = 16;
/// Bytes of a request's head.
const MOST_HEAD: usize = 16 << 10;
/// Time for a request's head.
const HEAD_TIME: Duration = Duration::from_secs(10);
/// Time for a client to take its answer.
const WRITE_TIME: Duration = Duration::from_secs(30);
/// Time without a message after which it is seen whether the client is still there.
const IDLE_TIME: Duration = Duration::from_secs(20);
/// How often a server looks whether it should end.
const LOOK: Duration = Duration::from_millis(10);
/// Time for clients to end when the server does.
const END_TIME: Duration = Duration::from_secs(1);

/// A server that listens.
pub struct Server {
    listener: TcpListener,
    address: SocketAddr,
    shared: Arc<Shared>,
}

struct Shared {
    service: Service,
    limits: Limits,
    token: Option<String>,
    metadata: Vec<u8>,
    /// every connection, to end it
    connections: Mutex<BTreeMap<u64, TcpStream>>,
    clients: AtomicU64,
    queries: AtomicU64,
    errors: AtomicU64,
    microseconds: AtomicU64,
}

impl Server {
    /// Listens on `host` and `port`; port 0 is one that is free. Clients have to know the `token`, if there is one.
    ///
    /// # Errors
    /// An address that other machines reach, without a token; one that cannot be listened on; a token that cannot be sent.
    pub fn bind(host: &str, port: u16, token: Option<String>, service: Service, limits: Limits) -> Result<Self> {
        if let Some(token) = &token {
            let found = if token.is_empty() { Some("an empty one") } else { None };
            let plain = token.bytes().all(|byte| byte.is_ascii_graphic());
            if let Some(found) = found.or((!plain).then_some("other characters")) {
                return Err(ServingError::Token { found });
            }
        }
        let shown = format!("{host}:{port}");
        let failed = |source| ServingError::Listen { address: shown.clone(), source };
        let addresses: Vec<SocketAddr> = (host, port).to_socket_addrs().map_err(failed)?.collect();
        if token.is_none() && addresses.iter().any(|address| !address.ip().is_loopback()) {
            return Err(ServingError::Unprotected { address: shown });
        }
        let listener = TcpListener::bind(addresses.as_slice()).map_err(failed)?;
        listener.set_nonblocking(true).map_err(failed)?;
        let address = listener.local_addr().map_err(failed)?;
        let metadata = encode(&service.metadata(limits.message));
        let shared = Shared {
            service,
            limits,
            token,
            metadata,
            connections: Mutex::default(),
            clients: AtomicU64::new(0),
            queries: AtomicU64::new(0),
            errors: AtomicU64::new(0),
            microseconds: AtomicU64::new(0),
        };
        Ok(Self { listener, address, shared: Arc::new(shared) })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Queries answered so far.
    pub fn queries(&self) -> u64 {
        self.shared.queries.load(Ordering::Relaxed)
    }

    /// Serves until `stop` says so; clients are disconnected then.
    pub fn run(&self, stop: &dyn Fn() -> bool) {
        let mut next = 0;
        while !stop() {
            match self.listener.accept() {
                Ok((stream, _)) => {
                    next += 1;
                    let shared = Arc::clone(&self.shared);
                    shared.begin(next, stream);
                }
                // nobody waits, or a client left before it was let in, or there are no file descriptors left for now
                Err(_) => thread::sleep(LOOK),
            }
        }
        for stream in self.shared.connections().values() {
            // it may be gone
            let _ = stream.shutdown(Shutdown::Both);
        }
        let until = Instant::now() + END_TIME;
        while !self.shared.connections().is_empty() && Instant::now() < until {
            thread::sleep(LOOK);
        }
    }
}

/// A connection in the list of them, as long as this is there.
struct Connection {
    shared: Arc<Shared>,
    number: u64,
}

impl Drop for Connection {
    fn drop(&mut self) {
        self.shared.connections().remove(&self.number);
    }
}

/// A client in the count of them.
struct Client<'a>(&'a AtomicU64);

impl Drop for Client<'_> {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::SeqCst);
    }
}

/// What a client speaks.
enum Talk<'a> {
    /// openpi's: a chunk for every query
    Chunks(Session<'a>),
    /// vla-eval's: an action for every step
    Steps(vla_eval::Session<'a>),
}

impl Talk<'_> {
    /// The message that says what is wrong with the client's message `seq`.
    fn error(&self, text: &str, seq: i128) -> Message {
        match self {
            Self::Chunks(_) => Message::text(text.to_owned()),
            Self::Steps(_) => Message::binary(vla_eval::error(text.to_owned(), seq)),
        }
    }
}

/// The head of a request, as far as it matters.
struct Request {
    path: String,
    headers: Vec<(String, String)>,
    /// what came after it
    rest: Vec<u8>,
}

impl Request {
    fn header(&self, name: &str) -> Option<&str> {
        self.headers.iter().find(|(other, _)| other.eq_ignore_ascii_case(name)).map(|(_, value)| value.trim())
    }
}

impl Shared {
    fn connections(&self) -> MutexGuard<'_, BTreeMap<u64, TcpStream>> {
        self.connections.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Serves a connection on a thread of its own.
    fn begin(self: Arc<Self>, number: u64, stream: TcpStream) {
        let Ok(handle) = stream.try_clone() else { return };
        {
            let mut connections = self.connections();
            if connections.len() >= self.limits.clients + FURTHER {
                return;
            }
            connections.insert(number, handle);
        }
        let connection = Connection { shared: self, number };
        // without a thread the closure is dropped, and the connection with it
        let _ = thread::Builder::new().name(format!("client {number}")).spawn(move || {
            // a connection that ends is not an error of the server's
            let _ = catch_unwind(AssertUnwindSafe(|| connection.shared.connected(stream)));
        });
    }

    fn connected(&self, mut stream: TcpStream) -> io::Result<()> {
        stream.set_nonblocking(false)?;
        stream.set_nodelay(true)?;
        stream.set_write_timeout(Some(WRITE_TIME))?;
        let request = match read_head(&mut stream)? {
            Ok(request) => request,
            Err(status) => return answer(&mut stream, status, "expected a GET request of HTTP/1.1\n"),
        };
        if request.path == "/healthz" {
            return answer(&mut stream, "200 OK", "OK\n");
        }
        if let Err(text) = self.let_in(&request) {
            return answer(&mut stream, "401 Unauthorized", text);
        }
        if request.path == "/metrics" {
            return answer(&mut stream, "200 OK", &self.metrics());
        }
        let key = request.header("sec-websocket-key");
        let upgrade = request.header("upgrade").is_some_and(|to| to.eq_ignore_ascii_case("websocket"));
        let (Some(key), true, Some("13")) = (key, upgrade, request.header("sec-websocket-version")) else {
            let text = "expected a WebSocket, or GET /healthz or /metrics\n";
            return answer(&mut stream, "426 Upgrade Required", text);
        };
        let mut talk = match (request.path == vla_eval::PATH, &self.service.steps) {
            (false, _) => Talk::Chunks(Session::new(&self.service)),
            (true, Some(steps)) => Talk::Steps(vla_eval::Session::new(steps)),
            (true, None) => return answer(&mut stream, "404 Not Found", "expected a policy that vla-eval can ask\n"),
        };
        let count = self.clients.fetch_add(1, Ordering::SeqCst);
        let _client = Client(&self.clients);
        if count >= self.limits.clients as u64 {
            let text = format!("expected at most {} clients\n", self.limits.clients);
            return answer(&mut stream, "503 Service Unavailable", &text);
        }
        let accept = derive_accept_key(key.as_bytes());
        let head = format!(
            "HTTP/1.1 101 Switching Protocols\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Accept: {accept}\r\n\r\n"
        );
        stream.write_all(head.as_bytes())?;
        stream.set_read_timeout(Some(IDLE_TIME))?;
        let config = WebSocketConfig::default()
            .max_message_size(Some(self.limits.message))
            .max_frame_size(Some(self.limits.message));
        // what closes it is no matter of the server's
        let mut socket = WebSocket::from_partially_read(stream, request.rest, Role::Server, Some(config));
        let _ = self.talk(&mut socket, &mut talk);
        Ok(())
    }

    /// Whether a client may come in: who knows the token; without one, what is not a page of a browser.
    fn let_in(&self, request: &Request) -> std::result::Result<(), &'static str> {
        match &self.token {
            Some(token) => {
                let given = request.header("authorization").and_then(|value| value.strip_prefix("Api-Key "));
                match given.is_some_and(|given| equal(given.trim().as_bytes(), token.as_bytes())) {
                    true => Ok(()),
                    false => Err("expected the header Authorization: Api-Key with the server's token\n"),
                }
            }
            None if request.header("origin").is_some() => {
                Err("expected no Origin: web pages need a server with a token\n")
            }
            None => Ok(()),
        }
    }

    fn talk<'a>(&'a self, socket: &mut WebSocket<TcpStream>, talk: &mut Talk<'a>) -> tungstenite::Result<()> {
        use tungstenite::Error;
        if let Talk::Chunks(_) = talk {
            socket.send(Message::binary(self.metadata.clone()))?;
        }
        loop {
            let answer = match socket.read() {
                Ok(Message::Binary(message)) => self.query(talk, &message),
                Ok(Message::Text(_)) => {
                    self.errors.fetch_add(1, Ordering::Relaxed);
                    let error = ServingError::message("message", "a binary one (MessagePack)", "a text");
                    Some(talk.error(&error.to_string(), 0))
                }
                Ok(_) => continue,
                Err(Error::Io(error)) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => {
                    socket.send(Message::Ping(Vec::new().into()))?;
                    continue;
                }
                Err(Error::Capacity(found)) => {
                    let expected = format!("at most {} bytes", self.limits.message);
                    let found = match found {
                        CapacityError::MessageTooLong { size, .. } => size.to_string(),
                        other => other.to_string(),
                    };
                    let error = ServingError::message("message", expected, found).to_string();
                    socket.send(talk.error(&error, 0))?;
                    let reason = "message too big".into();
                    socket.close(Some(CloseFrame { code: CloseCode::Size, reason }))?;
                    drain(socket.get_mut());
                    return Ok(());
                }
                Err(error) => return Err(error),
            };
            if let Some(answer) = answer {
                socket.send(answer)?;
            }
        }
    }

    /// The answer to a message, where it asks for one; an error is one line.
    fn query<'a>(&'a self, talk: &mut Talk<'a>, message: &[u8]) -> Option<Message> {
        let begun = Instant::now();
        let answered = catch_unwind(AssertUnwindSafe(|| match talk {
            Talk::Chunks(session) => session.answer(message).map(Some).map_err(|error| (error, 0)),
            Talk::Steps(session) => session.answer(message),
        }));
        let microseconds = u64::try_from(begun.elapsed().as_micros()).unwrap_or(u64::MAX);
        self.microseconds.fetch_add(microseconds, Ordering::Relaxed);
        self.queries.fetch_add(1, Ordering::Relaxed);
        let (error, seq) = match answered {
            Ok(Ok(answer)) => return answer.map(Message::binary),
            Ok(Err((error, seq))) => (error.to_string().replace(['\n', '\r'], " "), seq),
            Err(_) => {
                *talk = match talk {
                    Talk::Chunks(_) => Talk::Chunks(Session::new(&self.service)),
                    Talk::Steps(session) => Talk::Steps(session.anew()),
                };
                ("policy: it failed on this observation, and its episode was ended".to_owned(), 0)
            }
        };
        self.errors.fetch_add(1, Ordering::Relaxed);
        Some(talk.error(&error, seq))
    }

    /// For Prometheus.
    fn metrics(&self) -> String {
        let read = |number: &AtomicU64| number.load(Ordering::Relaxed);
        let milliseconds = read(&self.microseconds) as f64 / 1e3;
        format!(
            "# HELP actrm_queries_total Messages received: observations, and of vla-eval also the begin and end of episodes.\n# TYPE actrm_queries_total counter\n\
             actrm_queries_total {}\n\
             # HELP actrm_query_errors_total Messages answered with an error.\n# TYPE actrm_query_errors_total counter\n\
             actrm_query_errors_total {}\n\
             # HELP actrm_query_milliseconds_total Time spent on messages.\n\
             # TYPE actrm_query_milliseconds_total counter\nactrm_query_milliseconds_total {milliseconds}\n\
             # HELP actrm_clients Clients connected.\n# TYPE actrm_clients gauge\nactrm_clients {}\n",
            read(&self.queries),
            read(&self.errors),
            read(&self.clients),
        )
    }
}

/// Takes what a client still sends, for a while, so that it gets to read why it was refused.
fn drain(stream: &mut TcpStream) {
    let until = Instant::now() + HEAD_TIME;
    let mut buffer = vec![0; 64 << 10];
    while Instant::now() < until && stream.read(&mut buffer).is_ok_and(|count| count > 0) {}
}

/// In a time that depends on the lengths only.
fn equal(given: &[u8], expected: &[u8]) -> bool {
    let differences = given.iter().zip(expected).fold(0, |differences, (a, b)| differences | (a ^ b));
    std::hint::black_box(differences) == 0 && given.len() == expected.len()
}

/// Reads the head of a request, or says the status of the refusal.
fn read_head(stream: &mut TcpStream) -> io::Result<std::result::Result<Request, &'static str>> {
    let until = Instant::now() + HEAD_TIME;
    let mut bytes = Vec::new();
    let mut buffer = [0; 2048];
    loop {
        let left = until.saturating_duration_since(Instant::now());
        if left.is_zero() {
            return Err(ErrorKind::TimedOut.into());
        }
        stream.set_read_timeout(Some(left))?;
        let count = stream.read(&mut buffer)?;
        if count == 0 {
            return Err(ErrorKind::UnexpectedEof.into());
        }
        bytes.extend_from_slice(&buffer[..count]);
        let mut headers = [httparse::EMPTY_HEADER; 64];
        let mut head = httparse::Request::new(&mut headers);
        match head.parse(&bytes) {
            Ok(httparse::Status::Partial) if bytes.len() > MOST_HEAD => {
                return Ok(Err("431 Request Header Fields Too Large"));
            }
            Ok(httparse::Status::Partial) => {}
            Ok(httparse::Status::Complete(length)) if head.method == Some("GET") => {
                let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
                let headers = head.headers.iter().map(|header| (header.name.to_owned(), text(header.value))).collect();
                let path = head.path.unwrap_or_default().split('?').next().unwrap_or_default().to_owned();
                return Ok(Ok(Request { path, headers, rest: bytes[length..].to_vec() }));
            }
            Ok(httparse::Status::Complete(_)) => return Ok(Err("405 Method Not Allowed")),
            Err(_) => return Ok(Err("400 Bad Request")),
        }
    }
}

fn answer(stream: &mut TcpStream, status: &str, text: &str) -> io::Result<()> {
    let length = text.len();
    // one write, so that a client which reads once has all of it
    let whole = format!(
        "HTTP/1.1 {status}\r\nContent-Type: text/plain; charset=utf-8\r\nContent-Length: {length}\r\nConnection: close\r\n\r\n{text}"
    );
    stream.write_all(whole.as_bytes())?;
    stream.shutdown(Shutdown::Write)
}
