//! From publishing to receiving, by size: shared memory, zenoh and DDS on this machine, in one run.
//!
//! `cargo bench --bench iceoryx2 [-- MESSAGES]`. Publisher and reader are threads with a session each; one message is
//! under way at a time. Filling the message is not in the figures, for nobody's.

use std::{
    error::Error,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
        mpsc::{Receiver, Sender, channel},
    },
    thread::JoinHandle,
    time::{Duration, Instant},
};

use futures::StreamExt;
use iceoryx2::{port::publisher::Publisher, prelude::*, service::ipc_threadsafe};
use nightflow::wire::{self, Image, Message};
use ros2_client::{
    MessageTypeName, Name, NodeName, NodeOptions, QosProfile,
    dds::Context,
    qos::{History, WhenFull},
};
use rustdds::DomainParticipantBuilder;
use zenoh::Wait;

const SIZES: [usize; 5] = [64, 4 << 10, 64 << 10, 1 << 20, 4 << 20];
const PATIENCE: Duration = Duration::from_secs(2);
/// Between messages, as a fast camera has it: every side has gone to sleep by then.
const PAUSE: Duration = Duration::from_millis(4);
/// Whether the pause comes before a message is filled, which is then sent at once, or between filling and sending.
static PAUSE_FIRST: AtomicBool = AtomicBool::new(false);

type Outcome<T> = Result<T, Box<dyn Error>>;

type Open = fn() -> Outcome<Box<dyn Way>>;

/// Sends one message of a size; the arrival comes through a channel.
trait Way {
    /// Makes the next message ready, then gives what sends it.
    fn send(&mut self, size: usize) -> Outcome<Instant>;
    /// When messages arrived.
    fn arrivals(&self) -> &Receiver<Instant>;
}

/// Stops a reader's thread when the way is dropped.
struct Reader {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Drop for Reader {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

struct Shared {
    publisher: Publisher<ipc_threadsafe::Service, [u8], ()>,
    wake: iceoryx2::port::notifier::Notifier<ipc_threadsafe::Service>,
    arrivals: Receiver<Instant>,
    _reader: Reader,
}

impl Shared {
    fn open() -> Outcome<Self> {
        set_log_level(LogLevel::Error);
        let name: ServiceName = format!("nightflow_bench/{}", std::process::id()).as_str().try_into()?;
        let node = NodeBuilder::new()
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<ipc_threadsafe::Service>()?;
        let service = node.service_builder(&name).publish_subscribe::<[u8]>().max_subscribers(1).create()?;
        let publisher = service.publisher_builder().initial_max_slice_len(SIZES[SIZES.len() - 1]).create()?;
        let event = node.service_builder(&name).event().create()?;
        let wake = event.notifier_builder().create()?;
        let (subscriber, listener) = (service.subscriber_builder().create()?, event.listener_builder().create()?);
        let (sender, arrivals) = channel();
        let stop = Arc::new(AtomicBool::new(false));
        let thread = std::thread::spawn({
            let stop = Arc::clone(&stop);
            move || {
                while !stop.load(Ordering::Acquire) {
                    let _ = listener.timed_wait(|_| {}, Duration::from_millis(100));
                    while let Ok(Some(sample)) = subscriber.receive() {
                        arrived(&sender, sample.payload());
                    }
                }
            }
        });
        Ok(Self { publisher, wake, arrivals, _reader: Reader { stop, thread: Some(thread) } })
    }
}

impl Way for Shared {
    fn send(&mut self, size: usize) -> Outcome<Instant> {
        let sample = self.publisher.loan_slice_uninit(size)?.write_from_fn(|_| 1);
        let sent = ready();
        sample.send()?;
        self.wake.notify()?;
        Ok(sent)
    }

    fn arrivals(&self) -> &Receiver<Instant> {
        &self.arrivals
    }
}

struct Zenoh {
    publisher: zenoh::pubsub::Publisher<'static>,
    arrivals: Receiver<Instant>,
    _sessions: [zenoh::Session; 2],
}

impl Zenoh {
    fn open() -> Outcome<Self> {
        let port = std::net::TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
        let session = |role: &str| {
            let mut config = zenoh::Config::default();
            config.insert_json5("scouting/multicast/enabled", "false")?;
            config.insert_json5(role, &format!("[\"tcp/127.0.0.1:{port}\"]"))?;
            zenoh::open(config).wait()
        };
        let said = |e: zenoh::Error| -> Box<dyn Error> { e.to_string().into() };
        let (ours, theirs) = (session("listen/endpoints").map_err(said)?, session("connect/endpoints").map_err(said)?);
        let (sender, arrivals) = channel();
        theirs
            .declare_subscriber("nightflow/bench")
            .callback(move |sample| arrived(&sender, &sample.payload().to_bytes()))
            .background()
            .wait()
            .map_err(said)?;
        let publisher = ours.declare_publisher("nightflow/bench").wait().map_err(said)?;
        std::thread::sleep(Duration::from_secs(1));
        Ok(Self { publisher, arrivals, _sessions: [ours, theirs] })
    }
}

impl Way for Zenoh {
    fn send(&mut self, size: usize) -> Outcome<Instant> {
        let payload = zenoh::bytes::ZBytes::from(vec![1_u8; size]);
        let sent = ready();
        self.publisher.put(payload).wait().map_err(|e| e.to_string())?;
        Ok(sent)
    }

    fn arrivals(&self) -> &Receiver<Instant> {
        &self.arrivals
    }
}

struct Dds {
    publisher: ros2_client::dds::Publisher<Image>,
    arrivals: Receiver<Instant>,
    _node: ros2_client::dds::Node,
}

impl Dds {
    fn open() -> Outcome<Self> {
        let node = |name: &str| -> Outcome<ros2_client::dds::Node> {
            let participant = DomainParticipantBuilder::new(77).socket_receive_buffer_size(4 << 20).build()?;
            let options = NodeOptions::new().enable_rosout(false).start_parameter_services(false);
            let context = Context::from_domain_participant(participant)?;
            context.new_node(NodeName::new("/", name)?, options).map_err(|e| format!("{e:?}").into())
        };
        let qos = QosProfile::publisher_default()
            .reliability_reliable(WhenFull::DEFAULT)
            .history(History::KeepLast { depth: 2 });
        let (mut ours, mut theirs) = (node("bench_out")?, node("bench_in")?);
        let kind = || MessageTypeName::new(Image::PACKAGE, Image::NAME);
        let topic = Name::parse("/nightflow_bench")?;
        let publisher = ours.create_publisher(&ours.create_topic(&topic, kind(), &qos)?, Some(qos.clone()))?;
        let reader =
            theirs.create_subscription::<Image>(&theirs.create_topic(&topic, kind(), &qos)?, Some(qos.clone()))?;
        let (sender, arrivals) = channel();
        std::thread::spawn(move || {
            let _node = theirs;
            futures::executor::block_on(reader.async_stream().for_each(|read| {
                if let Ok((image, _)) = read {
                    arrived(&sender, &image.data);
                }
                std::future::ready(())
            }));
        });
        std::thread::sleep(Duration::from_secs(3));
        Ok(Self { publisher, arrivals, _node: ours })
    }
}

impl Way for Dds {
    fn send(&mut self, size: usize) -> Outcome<Instant> {
        let image = Image { data: vec![1; size], ..Image::default() };
        let sent = ready();
        self.publisher.publish(image).map_err(|e| e.to_string())?;
        Ok(sent)
    }

    fn arrivals(&self) -> &Receiver<Instant> {
        &self.arrivals
    }
}

/// The message lies ready: the clock starts, now or after the pause.
fn ready() -> Instant {
    if !PAUSE_FIRST.load(Ordering::Relaxed) {
        std::thread::sleep(PAUSE);
    }
    Instant::now()
}

/// Looks at both ends of what came, so that nobody gets away with not delivering it.
fn arrived(sender: &Sender<Instant>, payload: &[u8]) {
    assert!(payload.first() == Some(&1) && payload.last() == Some(&1), "what came is not what was sent");
    let _ = sender.send(Instant::now());
}

/// What one size took, in microseconds, and how many messages never came.
#[derive(Default)]
struct Took {
    us: Vec<f64>,
    lost: usize,
}

impl Took {
    fn quantile(&self, q: f64) -> f64 {
        self.us.get(((self.us.len().max(1) - 1) as f64 * q) as usize).copied().unwrap_or(f64::NAN)
    }
}

/// All sizes in turn, message by message, so that whatever else the machine does meets each of them alike.
fn measure(way: &mut dyn Way, messages: usize) -> Outcome<[Took; SIZES.len()]> {
    let mut all: [Took; SIZES.len()] = Default::default();
    // The first ones make room.
    for k in 0..messages + 10 {
        for (took, size) in all.iter_mut().zip(SIZES) {
            if took.lost > 5 {
                continue;
            }
            while way.arrivals().try_recv().is_ok() {}
            if PAUSE_FIRST.load(Ordering::Relaxed) {
                std::thread::sleep(PAUSE);
            }
            let sent = way.send(size)?;
            match way.arrivals().recv_timeout(PATIENCE) {
                Ok(at) if k >= 10 => took.us.push(at.saturating_duration_since(sent).as_secs_f64() * 1e6),
                Ok(_) => {}
                Err(_) => took.lost += 1,
            }
        }
    }
    all.iter_mut().for_each(|took| took.us.sort_by(f64::total_cmp));
    Ok(all)
}

fn main() -> Outcome<()> {
    let messages = std::env::args().filter_map(|arg| arg.parse().ok()).next().unwrap_or(300);
    let _ = wire::type_hash::<Image>();
    println!("publish to receive in µs, p50 / p99 of {messages} messages, one machine, one run\n");
    println!("| way | {} | p50 largest/smallest |", SIZES.map(size_name).join(" | "));
    println!("|---|{}---|", "---|".repeat(SIZES.len()));
    let ways: [(&str, Open); 4] = [
        ("iceoryx2, sent as soon as it is filled", || {
            PAUSE_FIRST.store(true, Ordering::Relaxed);
            Ok(Box::new(Shared::open()?))
        }),
        ("iceoryx2", || {
            PAUSE_FIRST.store(false, Ordering::Relaxed);
            Ok(Box::new(Shared::open()?))
        }),
        ("zenoh, TCP and its shared memory", || Ok(Box::new(Zenoh::open()?))),
        ("DDS, reliable", || Ok(Box::new(Dds::open()?))),
    ];
    for (name, open) in ways {
        let mut way = open()?;
        let all = measure(&mut *way, messages)?;
        let cells = all.iter().map(|took| {
            let lost = if took.lost > 0 { format!(" ({} lost)", took.lost) } else { String::new() };
            format!("{:.0} / {:.0}{lost}", took.quantile(0.5), took.quantile(0.99))
        });
        let cells: Vec<String> = cells.collect();
        let medians = all.iter().map(|took| took.quantile(0.5));
        let (least, most) = medians.fold((f64::MAX, 0.0_f64), |(a, b), m| (a.min(m), b.max(m)));
        println!("| {name} | {} | {:.2} |", cells.join(" | "), most / least);
    }
    Ok(())
}

fn size_name(size: usize) -> String {
    match size {
        0..1024 => format!("{size} B"),
        1024..1_048_576 => format!("{} KiB", size >> 10),
        _ => format!("{} MiB", size >> 20),
    }
}
