//! Frames, gyro, range and calibration over zenoh: under plain keys, or as rmw_zenoh sends them.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use ::zenoh::{
    Session, Wait,
    liveliness::LivelinessToken,
    pubsub::Subscriber,
    query::{ConsolidationMode, QueryTarget, ReplyKeyExpr},
    sample::SampleKind,
};

use super::{
    Config, Counts, Error, Frame, Next, Sample, Source, Zenoh,
    latest::{Latest, SMALL_ROOM, Sender, mailbox},
};
use crate::{
    clock,
    wire::{self, Message, rmw},
};

/// A live source: zenoh's own threads decode what arrives and put it into the mailbox.
pub struct ZenohSource {
    latest: Latest,
    // These end when they are dropped.
    _subscribers: Vec<Subscriber<()>>,
    _tokens: Vec<LivelinessToken>,
    session: Session,
}

impl ZenohSource {
    /// Connects and subscribes. Routers and publishers may come, go and come again at any time.
    pub fn open(config: &Config, settings: &Zenoh) -> Result<Self, Error> {
        let session = session(&settings.connect, &settings.listen).map_err(lost)?;
        let (sender, latest) = mailbox(SMALL_ROOM);
        let latest = latest.exposing(config.exposure_s);
        let mut opening = Opening::new(&session, settings, sender).map_err(lost)?;
        opening
            .subscribe(&config.image_topic, |image| Sample::Frame(Arc::new(Frame { image, received: clock::now() })))?;
        opening.subscribe(&config.info_topic, |info| Sample::Info(Arc::new(info)))?;
        opening.subscribe(&config.imu_topic, |imu| Sample::Imu(Arc::new(imu)))?;
        opening.subscribe(&config.range_topic, |range| Sample::Range(Arc::new(range)))?;
        if !config.tf_topic.is_empty() {
            opening.subscribe_kept(&config.tf_topic, |message| Sample::Transforms(Arc::new(message)))?;
        }
        let Opening { subscribers, tokens, .. } = opening;
        Ok(Self { latest, _subscribers: subscribers, _tokens: tokens, session })
    }
}

impl Source for ZenohSource {
    fn next(&mut self, wait: Duration) -> Result<Next, Error> {
        self.latest.next(wait)
    }

    fn counts(&self) -> Counts {
        self.latest.counts()
    }
}

impl Drop for ZenohSource {
    fn drop(&mut self) {
        if let Err(why) = self.session.close().wait() {
            tracing::debug!("the zenoh session did not close: {why}");
        }
    }
}

/// A session over TCP with shared memory, found by nobody but through these endpoints and the routers behind them.
pub(crate) fn session(connect: &[String], listen: &[String]) -> Result<Session, String> {
    // Nodes of one machine talk directly, as those of rmw_zenoh do; the router only introduces them.
    let nearby = ["tcp/localhost:0".to_owned()];
    let listen = if listen.is_empty() { &nearby } else { listen };
    let list = |endpoints: &[String]| format!("{endpoints:?}");
    let mut config = ::zenoh::Config::default();
    for (key, value) in [
        ("mode", "\"peer\"".to_owned()),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("scouting/gossip/target", "{router: [\"router\", \"peer\"], peer: [\"router\"]}".to_owned()),
        ("transport/shared_memory/enabled", "true".to_owned()),
        ("connect/endpoints", list(connect)),
        ("listen/endpoints", list(listen)),
    ] {
        config.insert_json5(key, &value).map_err(|e| format!("{key} = {value}: {e}"))?;
    }
    ::zenoh::open(config).wait().map_err(|e| format!("connect {connect:?}, listen {listen:?}: {e}"))
}

fn lost(reason: impl ToString) -> Error {
    Error::Lost { source_name: "zenoh".into(), reason: reason.to_string() }
}

struct Opening<'a> {
    session: &'a Session,
    sender: Sender,
    /// With rmw_zenoh's keys: the node that the ROS graph shows.
    node: Option<rmw::Node>,
    subscribers: Vec<Subscriber<()>>,
    tokens: Vec<LivelinessToken>,
}

impl<'a> Opening<'a> {
    fn new(session: &'a Session, settings: &Zenoh, sender: Sender) -> ::zenoh::Result<Self> {
        let node = settings.rmw.then(|| rmw::Node {
            domain: settings.domain,
            session: session.zid().to_string(),
            name: "nightflow_camera".into(),
        });
        let mut tokens = vec![];
        if let Some(node) = &node {
            tokens.push(session.liveliness().declare_token(node.token()).wait()?);
        }
        Ok(Self { session, sender, node, subscribers: vec![], tokens })
    }

    fn subscribe<M: Message>(&mut self, topic: &str, sample: fn(M) -> Sample) -> Result<(), Error> {
        self.listen(topic, &self.arrivals(sample), rmw::QOS_SENSOR)
    }

    /// Also takes what was sent before we came, from publishers that keep it: those of rmw_zenoh do so where their
    /// durability is transient local, and answer for it under `@adv` as zenoh's advanced publishers do.
    fn subscribe_kept<M: Message>(&mut self, topic: &str, sample: fn(M) -> Sample) -> Result<(), Error> {
        let arrivals = self.arrivals(sample);
        self.listen(topic, &arrivals, rmw::QOS_KEPT)?;
        let key = format!("{}/@adv/**", self.key::<M>(topic));
        let (session, asked) = (self.session.clone(), key.clone());
        let ask = move || {
            let arrivals = Arc::clone(&arrivals);
            let answers = move |reply: ::zenoh::query::Reply| {
                if let Ok(came) = reply.result() {
                    arrivals.take(came);
                }
            };
            let query = session.get(&asked).target(QueryTarget::All).consolidation(ConsolidationMode::None);
            query.accept_replies(ReplyKeyExpr::Any).callback(answers).wait()
        };
        ask().map_err(lost)?;
        // And once more for each publisher that comes later, for it may have spoken before it saw us.
        let appeared = move |came: ::zenoh::sample::Sample| {
            if came.kind() == SampleKind::Put
                && let Err(why) = ask()
            {
                tracing::debug!("what {} keeps was not asked for: {why}", came.key_expr());
            }
        };
        let watching = self.session.liveliness().declare_subscriber(&key).callback(appeared).wait().map_err(lost)?;
        self.subscribers.push(watching);
        Ok(())
    }

    fn key<M: Message>(&self, topic: &str) -> String {
        match &self.node {
            Some(node) => rmw::any_hash_key::<M>(node.domain, topic),
            None => rmw::plain_key(topic).to_owned(),
        }
    }

    fn arrivals<M: Message>(&self, sample: fn(M) -> Sample) -> Arc<Arrivals<M>> {
        Arc::new(Arrivals {
            sender: self.sender.clone(),
            sample,
            hash: self.node.as_ref().map(|_| wire::type_hash::<M>()),
            told: AtomicBool::new(false),
        })
    }

    fn listen<M: Message>(&mut self, topic: &str, arrivals: &Arc<Arrivals<M>>, qos: &str) -> Result<(), Error> {
        let (key, arrivals) = (self.key::<M>(topic), Arc::clone(arrivals));
        let subscriber = self.session.declare_subscriber(&key).callback(move |came| arrivals.take(&came)).wait();
        self.subscribers.push(subscriber.map_err(|e| Error::Settings(format!("{topic} is no topic for zenoh: {e}")))?);
        if let Some(node) = &self.node {
            let id = self.tokens.len() as u64;
            let token = node.endpoint_token::<M>(id, rmw::Endpoint::Subscription, topic, qos);
            self.tokens.push(self.session.liveliness().declare_token(token).wait().map_err(lost)?);
        }
        Ok(())
    }
}

/// What becomes of one topic's messages.
struct Arrivals<M> {
    sender: Sender,
    sample: fn(M) -> Sample,
    /// The hash that an rmw_zenoh key should end in.
    hash: Option<String>,
    told: AtomicBool,
}

impl<M: Message> Arrivals<M> {
    fn take(&self, came: &::zenoh::sample::Sample) {
        if came.kind() != SampleKind::Put {
            return;
        }
        self.check_hash(came.key_expr().as_str());
        match wire::decode::<M>(&came.payload().to_bytes()) {
            Ok(message) => {
                let sample = (self.sample)(message);
                let attachment = came.attachment().and_then(|bytes| rmw::Attachment::from_bytes(&bytes.to_bytes()));
                if let (Sample::Frame(_), Some(attachment)) = (&sample, attachment) {
                    self.sender.numbered(attachment.gid, attachment.sequence);
                }
                self.sender.put(sample);
            }
            Err(why) => {
                tracing::debug!("a message on {} is torn: {why}", came.key_expr());
                self.sender.torn();
            }
        }
    }

    /// Another hash means another definition of the message: it may decode to nonsense, and whoever looks for the
    /// cause should find this line. It is told once.
    fn check_hash(&self, key: &str) {
        let Some(hash) = &self.hash else { return };
        if !key.ends_with(hash.as_str()) && !self.told.swap(true, Ordering::Relaxed) {
            tracing::warn!("{key} carries another definition of {} than ours, {hash}", wire::ros_name::<M>());
        }
    }
}
