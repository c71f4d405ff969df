//! The MAVLink line itself: opened again when it is lost, a heartbeat each second, an answer to every TIMESYNC.

use std::{
    io::ErrorKind,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use mavlink::{
    Connectable, Connection, MavConnection, MavHeader, SerialConfig, UdpConfig, UdpMode,
    dialects::common::{HEARTBEAT_DATA, MavAutopilot, MavMessage, MavModeFlag, MavState, MavType, TIMESYNC_DATA},
    error::MessageReadError,
};

use super::{Link, Mavlink};
use crate::clock;

const HEARTBEAT: Duration = Duration::from_secs(1);
/// Between two tries to open a line that was lost.
const RETRY: Duration = Duration::from_secs(1);
/// How long the listener waits for bytes before it looks whether it should end.
const LISTEN: Duration = Duration::from_millis(50);
/// A serial line is waited for this long, both ways: what is read waits no longer for a thread that writes.
const SERIAL: Duration = Duration::from_millis(5);

/// The way to the autopilot.
pub(super) struct Wire {
    link: Link,
    header: MavHeader,
    offset_us: i64,
    line: Option<Line>,
    retry_at: Instant,
    heartbeat_at: Instant,
}

/// An open line, and the thread that listens to it.
struct Line {
    connection: Arc<Connection<MavMessage>>,
    stop: Arc<AtomicBool>,
    listening: Option<JoinHandle<()>>,
}

impl Wire {
    /// Opens the line; one that can't be opened at the start is the user's mistake.
    pub(super) fn open(settings: &Mavlink) -> Result<Self, String> {
        let now = clock::instant();
        let mut wire = Self {
            link: settings.link.clone(),
            header: MavHeader { system_id: settings.system.into(), component_id: settings.component, sequence: 0 },
            offset_us: settings.time_offset_us,
            line: None,
            retry_at: now,
            heartbeat_at: now,
        };
        wire.line = Some(wire.connect()?);
        Ok(wire)
    }

    fn connect(&self) -> Result<Line, String> {
        let failed = |why: std::io::Error| match &self.link {
            Link::Udp(address) => format!("{address}: {why}"),
            Link::Serial(serial) => format!("{}: {why}", serial.path.display()),
        };
        let mut connection = match &self.link {
            Link::Udp(address) => {
                UdpConfig::new(address.clone(), UdpMode::Udpout).read_timeout(LISTEN).connect::<MavMessage>()
            }
            Link::Serial(serial) => {
                SerialConfig::new(serial.path.display().to_string(), serial.baud).timeout(SERIAL).connect()
            }
        }
        .map_err(failed)?;
        connection.set_allow_recv_any_version(true);
        let (connection, stop) = (Arc::new(connection), Arc::new(AtomicBool::new(false)));
        let listener = Listener {
            connection: Arc::clone(&connection),
            stop: Arc::clone(&stop),
            header: self.header,
            offset_us: self.offset_us,
            serial: matches!(self.link, Link::Serial(_)),
        };
        let listening = std::thread::Builder::new()
            .name("publish-mavlink-in".into())
            .spawn(move || listener.run())
            .map_err(failed)?;
        Ok(Line { connection, stop, listening: Some(listening) })
    }

    /// Sends a message; a line that fails is closed, and opened again by [`Wire::tend`].
    pub(super) fn send(&mut self, message: &MavMessage) -> Result<(), String> {
        let Some(line) = &self.line else { return Err("the line is lost".into()) };
        if let Err(why) = line.connection.send(&self.header, message) {
            self.line = None;
            self.retry_at = clock::instant() + RETRY;
            return Err(why.to_string());
        }
        Ok(())
    }

    /// Opens a lost line again, and says once a second that we are here.
    pub(super) fn tend(&mut self) -> Result<(), String> {
        let now = clock::instant();
        if self.line.is_none() {
            if now < self.retry_at {
                return Err("the line is lost".into());
            }
            self.retry_at = now + RETRY;
            self.line = Some(self.connect()?);
        }
        if now < self.heartbeat_at {
            return Ok(());
        }
        self.heartbeat_at = now + HEARTBEAT;
        self.send(&MavMessage::HEARTBEAT(HEARTBEAT_DATA {
            custom_mode: 0,
            mavtype: MavType::MAV_TYPE_ONBOARD_CONTROLLER,
            autopilot: MavAutopilot::MAV_AUTOPILOT_INVALID,
            base_mode: MavModeFlag::empty(),
            system_status: MavState::MAV_STATE_ACTIVE,
            mavlink_version: 3,
        }))
    }
}

impl Drop for Line {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(listening) = self.listening.take() {
            let _ = listening.join();
        }
    }
}

/// Answers TIMESYNC on a thread of its own: a request that waited for the next step would teach the autopilot a wrong
/// offset between the clocks, by half of its wait.
struct Listener {
    connection: Arc<Connection<MavMessage>>,
    stop: Arc<AtomicBool>,
    header: MavHeader,
    offset_us: i64,
    serial: bool,
}

impl Listener {
    fn run(self) {
        while !self.stop.load(Ordering::Relaxed) {
            // On a serial line `recv` never comes back without a message, and `try_recv` waits for some milliseconds.
            let heard = if self.serial { self.connection.try_recv() } else { self.connection.recv() };
            match heard {
                Ok((from, MavMessage::TIMESYNC(asked))) if asked.tc1 == 0 => self.answer(from, &asked),
                Ok(_) | Err(MessageReadError::Parse(_)) => {}
                Err(MessageReadError::Io(why)) => {
                    if !matches!(why.kind(), ErrorKind::TimedOut | ErrorKind::WouldBlock | ErrorKind::Interrupted) {
                        // The line is gone: whoever sends notices it too, and opens another.
                        std::thread::sleep(LISTEN);
                    }
                }
            }
        }
    }

    /// Our time in the very clock of the stamps that go out. A failure to answer shows when the next step is sent.
    fn answer(&self, from: MavHeader, asked: &TIMESYNC_DATA) {
        let tc1 = clock::now().ns().saturating_add(self.offset_us.saturating_mul(1000));
        let _ = self.connection.send(
            &self.header,
            &MavMessage::TIMESYNC(TIMESYNC_DATA {
                tc1,
                ts1: asked.ts1,
                target_system: u8::try_from(from.system_id).unwrap_or(0),
                target_component: from.component_id,
            }),
        );
    }
}
