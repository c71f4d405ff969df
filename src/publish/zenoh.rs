//! Results over zenoh: under plain keys, or as rmw_zenoh's subscribers expect them.

use ::zenoh::{Session, Wait, liveliness::LivelinessToken, pubsub::Publisher, qos::CongestionControl};

use super::{
    Config, Error, Zenoh,
    courier::{Courier, Message, Network, Topics},
};
use crate::{
    camera::zenoh::session,
    clock,
    wire::{self, DiagnosticArray, EgoMotion, Image, LaserScan, Status, Step, TwistWithCovarianceStamped, rmw},
};

const NAME: &str = "zenoh";

/// Connects and declares every topic; publishes, and drops rather than waits where a link is congested. Routers and
/// readers may come, go and come again.
pub fn open(config: &Config, settings: &Zenoh) -> Result<Courier, Error> {
    let outlets = Outlets::open(config, settings).map_err(|reason| Error::Open { sink: NAME, reason })?;
    Courier::open(NAME, config, outlets)
}

struct Outlets {
    velocity: Outlet,
    ego_motion: Outlet,
    proximity: Outlet,
    step: Outlet,
    status: Outlet,
    diagnostics: Outlet,
    flow: Outlet,
    confidence: Outlet,
    preview: Outlet,
    /// The ROS graph shows the node for as long as this stands.
    _node: Option<LivelinessToken>,
    session: Session,
}

impl Outlets {
    fn open(config: &Config, settings: &Zenoh) -> Result<Self, String> {
        let topics = Topics::of(config);
        let session = session(&settings.connect, &settings.listen)?;
        let node = settings.rmw.then(|| rmw::Node {
            domain: settings.domain,
            session: session.zid().to_string(),
            name: "nightflow".into(),
        });
        let token = node.as_ref().map(|node| stand(&session, node.token())).transpose()?;
        let mut opening = Opening { session: &session, node: node.as_ref(), id: 0 };
        Ok(Self {
            velocity: opening.outlet::<TwistWithCovarianceStamped>(&topics.velocity)?,
            ego_motion: opening.outlet::<EgoMotion>(&topics.ego_motion)?,
            proximity: opening.outlet::<LaserScan>(&topics.proximity)?,
            step: opening.outlet::<Step>(&topics.step)?,
            status: opening.outlet::<Status>(&topics.status)?,
            diagnostics: opening.outlet::<DiagnosticArray>(&topics.diagnostics)?,
            flow: opening.outlet::<Image>(&topics.flow)?,
            confidence: opening.outlet::<Image>(&topics.confidence)?,
            preview: opening.outlet::<Image>(&topics.preview)?,
            _node: token,
            session,
        })
    }
}

impl Network for Outlets {
    fn send(&mut self, message: Message<'_>) -> Result<(), String> {
        match message {
            Message::Velocity(message) => self.velocity.put(message),
            Message::EgoMotion(message) => self.ego_motion.put(message),
            Message::Proximity(message) => self.proximity.put(message),
            Message::Step(message) => self.step.put(message),
            Message::Status(message) => self.status.put(message),
            Message::Diagnostics(message) => self.diagnostics.put(message),
            Message::Flow(message) => self.flow.put(message),
            Message::Confidence(message) => self.confidence.put(message),
            Message::Preview(message) => self.preview.put(message),
        }
    }
}

impl Drop for Outlets {
    fn drop(&mut self) {
        if let Err(why) = self.session.close().wait() {
            tracing::debug!("the zenoh session did not close: {why}");
        }
    }
}

/// What every outlet is opened with.
struct Opening<'a> {
    session: &'a Session,
    node: Option<&'a rmw::Node>,
    id: u64,
}

impl Opening<'_> {
    fn outlet<M: wire::Message>(&mut self, topic: &str) -> Result<Outlet, String> {
        let key = match self.node {
            Some(node) => rmw::data_key::<M>(node.domain, topic),
            None => rmw::plain_key(topic).to_owned(),
        };
        let publisher = self
            .session
            .declare_publisher(key)
            .congestion_control(CongestionControl::Drop)
            .wait()
            .map_err(|e| format!("{topic}: {e}"))?;
        self.id += 1;
        let named = match self.node {
            Some(node) => {
                let key = node.endpoint_token::<M>(self.id, rmw::Endpoint::Publisher, topic, rmw::QOS_RELIABLE);
                let gid = rmw::gid(&key);
                Some(Named { gid, sequence: 0, _token: stand(self.session, key)? })
            }
            None => None,
        };
        Ok(Outlet { publisher, named, cdr: vec![] })
    }
}

/// One topic.
struct Outlet {
    publisher: Publisher<'static>,
    named: Option<Named>,
    cdr: Vec<u8>,
}

/// What rmw_zenoh knows of a publisher.
struct Named {
    gid: [u8; 16],
    sequence: i64,
    _token: LivelinessToken,
}

impl Outlet {
    fn put<M: wire::Message>(&mut self, message: &M) -> Result<(), String> {
        wire::encode(message, &mut self.cdr).map_err(|e| e.to_string())?;
        let mut put = self.publisher.put(self.cdr.as_slice());
        if let Some(named) = &mut self.named {
            named.sequence += 1;
            let attachment = rmw::Attachment { sequence: named.sequence, source_ns: clock::now().ns(), gid: named.gid };
            put = put.attachment(attachment.to_bytes());
        }
        put.wait().map_err(|e| e.to_string())
    }
}

fn stand(session: &Session, key: String) -> Result<LivelinessToken, String> {
    session.liveliness().declare_token(key).wait().map_err(|e| e.to_string())
}
