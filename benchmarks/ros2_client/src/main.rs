//! Arm of a dVRK on ROS 2 topics, with a ROS 2 implementation that is independent of Cyclone DDS.
//!
//!     ros2_client_arm DOMAIN COMMANDS JOINT...
//!
//! The arm is at rest. It publishes
//!
//! - a latched `/MTML/operating_state`: ENABLED, homed and not busy
//! - `/MTML/measured_js` at 1 kHz: all joints are at 0, except the last one, whose position counts the messages from 0
//!   to 999 in microradians
//! - `/MTML/gravity_compensation/setpoint_js` at 10 Hz: the dVRK's own gravity compensation is off
//!
//! After COMMANDS efforts on `/MTML/servo_jf`, the arm prints one line for each of them: the stamp [ns] and the efforts.
//! The last line has the number of measurements and of messages on the other command topics.

use ros2_client::{
    qos::{Durability, History, QosProfile, WhenFull},
    Context, ContextOptions, MessageTypeName, Name, Node, NodeName, NodeOptions, Publisher, Subscription,
};
use serde::{de::DeserializeOwned, Deserialize, Serialize};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

#[derive(Clone, Debug, Default, Serialize, Deserialize)]
struct Header {
    sec: i32,
    nanosec: u32,
    frame_id: String,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct JointState {
    header: Header,
    name: Vec<String>,
    position: Vec<f64>,
    velocity: Vec<f64>,
    effort: Vec<f64>,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct OperatingState {
    header: Header,
    state: String,
    is_homed: bool,
    is_busy: bool,
}

#[derive(Clone, Debug, Default, Serialize, Deserialize)]
struct Empty {
    structure_needs_at_least_one_member: u8,
}

const TYPE: (&str, &str) = ("sensor_msgs", "JointState");

fn qos(depth: usize, durability: Durability) -> QosProfile {
    QosProfile::publisher_default()
        .reliability_reliable(WhenFull::DEFAULT)
        .durability(durability)
        .history(History::KeepLast { depth })
}

fn publisher<M: Serialize>(node: &mut Node, topic: &str, kind: (&str, &str), qos: QosProfile) -> Publisher<M> {
    let (namespace, name) = topic.rsplit_once('/').unwrap();
    let name = Name::new(namespace, name).unwrap();
    let topic = node.create_topic(&name, MessageTypeName::new(kind.0, kind.1), &qos).unwrap();
    node.create_publisher(&topic, None).unwrap()
}

fn subscription<M: DeserializeOwned + 'static>(node: &mut Node, topic: &str, kind: (&str, &str)) -> Subscription<M> {
    let (namespace, name) = topic.rsplit_once('/').unwrap();
    let (name, qos) = (Name::new(namespace, name).unwrap(), qos(1000, Durability::Volatile));
    let topic = node.create_topic(&name, MessageTypeName::new(kind.0, kind.1), &qos).unwrap();
    node.create_subscription(&topic, None).unwrap()
}

/// Returns all messages that have arrived.
fn take<M: DeserializeOwned + 'static>(subscription: &Subscription<M>) -> Vec<M> {
    let mut messages = Vec::new();
    while let Some((message, _)) = subscription.take().expect("a message that can be decoded") {
        messages.push(message);
    }
    messages
}

/// Returns the present time as a header.
fn now() -> Header {
    let time = SystemTime::now().duration_since(UNIX_EPOCH).unwrap();
    Header { sec: time.as_secs() as i32, nanosec: time.subsec_nanos(), frame_id: String::new() }
}

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let domain: u16 = arguments[1].parse().expect("DOMAIN");
    let commands: usize = arguments[2].parse().expect("COMMANDS");
    let name: Vec<String> = arguments[3..].to_vec();
    let zero = vec![0.0; name.len()];

    let context = Context::with_options(ContextOptions::new().domain_id(domain)).unwrap();
    let mut node = context
        .new_node(NodeName::new("/", "ros2_client_arm").unwrap(), NodeOptions::new().enable_rosout(false))
        .unwrap();
    let states = publisher(&mut node, "/MTML/operating_state", ("crtk_msgs", "OperatingState"), qos(100, Durability::TransientLocal));
    let measured = publisher(&mut node, "/MTML/measured_js", TYPE, qos(100, Durability::Volatile));
    let gravity = publisher(&mut node, "/MTML/gravity_compensation/setpoint_js", TYPE, qos(100, Durability::Volatile));
    let efforts: Subscription<JointState> = subscription(&mut node, "/MTML/servo_jf", TYPE);
    let positions: Subscription<JointState> = subscription(&mut node, "/MTML/servo_jp", TYPE);
    let holds: Subscription<Empty> = subscription(&mut node, "/MTML/hold", ("std_msgs", "Empty"));
    states.publish(OperatingState { header: now(), state: "ENABLED".to_string(), is_homed: true, is_busy: false }).unwrap();

    let mut received: Vec<JointState> = Vec::new();
    let (mut number, mut num_positions, mut num_holds) = (0, 0, 0);
    let mut next = Instant::now();
    while received.len() < commands {
        received.extend(take(&efforts));
        num_positions += take(&positions).len();
        num_holds += take(&holds).len();
        if Instant::now() >= next {
            let mut position = zero.clone();
            *position.last_mut().unwrap() = 1e-6 * ((number % 1000) as f64);
            let (velocity, effort) = (zero.clone(), zero.clone());
            measured.publish(JointState { header: now(), name: name.clone(), position, velocity, effort }).unwrap();
            if number % 100 == 0 {
                let effort = zero.clone();
                let off = JointState { header: now(), name: name.clone(), position: vec![], velocity: vec![], effort };
                gravity.publish(off).unwrap();
            }
            number += 1;
            next = (next + Duration::from_millis(1)).max(Instant::now() - Duration::from_millis(100));
        }
        std::thread::sleep(Duration::from_micros(200));
    }
    for command in received {
        let stamp = i64::from(command.header.sec) * 1_000_000_000 + i64::from(command.header.nanosec);
        println!("{stamp} {:?}", command.effort);
    }
    println!("{number} measured_js, {num_positions} servo_jp, {num_holds} hold");
}
