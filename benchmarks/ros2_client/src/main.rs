//! Arm of a dVRK on ROS 2 topics, with a ROS 2 implementation that is independent of Cyclone DDS.
//!
//!     ros2_client_arm DOMAIN MESSAGES EFFORT...
//!
//! The arm is at rest in one pose. It publishes
//!
//! - a latched `/MTML/operating_state`: ENABLED, homed and not busy
//! - `/MTML/measured_js` at 1 kHz: joint k is at 0.1 k rad and has the k-th effort
//! - one message on `/MTML/malformed`, which names the type JointState but contains 12 bytes only
//!
//! The first publisher of commands starts the measurements, the stamp of which counts the messages in nanoseconds.
//! Commands on `/MTML/servo_jf` and `/MTML/servo_jp` must have one number per joint. Their stamps
//! count the messages in nanoseconds. Number k of message n must be k + 0.001 (n mod 1000). The arm prints the counts after MESSAGES
//! measurements and 2 s without a command.

use ros2_client::{
    qos::{Durability, History, QosProfile, WhenFull},
    Context, ContextOptions, MessageTypeName, Name, Node, NodeName, NodeOptions, Publisher, Subscription,
};
use serde::{Deserialize, Serialize};
use std::time::{Duration, Instant};

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

/// Number of commands, and of the commands that are not as expected.
#[derive(Default)]
struct Counts {
    received: u64,
    undecodable: u64,
    out_of_order: u64,
    lost: u64,
    wrong_content: u64,
    last: i64,
}

const TYPE: (&str, &str) = ("sensor_msgs", "JointState");

fn qos(depth: usize, durability: Durability) -> QosProfile {
    QosProfile::publisher_default()
        .reliability_reliable(WhenFull::DEFAULT)
        .durability(durability)
        .history(History::KeepLast { depth })
}

fn publisher<M: Serialize>(node: &mut Node, name: &str, kind: (&str, &str), qos: QosProfile) -> Publisher<M> {
    let name = Name::new("/MTML", name).unwrap();
    let topic = node.create_topic(&name, MessageTypeName::new(kind.0, kind.1), &qos).unwrap();
    node.create_publisher(&topic, None).unwrap()
}

fn subscription(node: &mut Node, name: &str) -> Subscription<JointState> {
    let (name, qos) = (Name::new("/MTML", name).unwrap(), qos(100, Durability::Volatile));
    let topic = node.create_topic(&name, MessageTypeName::new(TYPE.0, TYPE.1), &qos).unwrap();
    node.create_subscription(&topic, None).unwrap()
}

impl Counts {
    /// Takes all commands that have arrived. Returns whether there was one.
    fn take(&mut self, commands: &Subscription<JointState>, values: fn(&JointState) -> &Vec<f64>, joints: usize) -> bool {
        let before = self.received;
        loop {
            match commands.take() {
                Ok(None) => return self.received > before,
                Err(_) => self.undecodable += 1,
                Ok(Some((command, _))) => {
                    let number = i64::from(command.header.sec) * 1_000_000_000 + i64::from(command.header.nanosec);
                    self.received += 1;
                    if self.last != 0 {
                        self.out_of_order += u64::from(number <= self.last);
                        self.lost += (number - self.last - 1).max(0) as u64;
                    }
                    self.last = number;
                    let values = values(&command);
                    let expected = |k: usize| 1e-3 * ((number % 1000) as f64) + k as f64;
                    let right = values.len() == joints && (0..joints).all(|k| values[k] == expected(k));
                    self.wrong_content += u64::from(!right);
                }
            }
        }
    }

    fn print(&self, name: &str) {
        println!(
            "{name}: received {}, lost {}, out of order {}, wrong content {}, not decodable {}",
            self.received, self.lost, self.out_of_order, self.wrong_content, self.undecodable
        );
    }
}

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let domain: u16 = arguments[1].parse().expect("DOMAIN");
    let messages: u32 = arguments[2].parse().expect("MESSAGES");
    let effort: Vec<f64> = arguments[3..].iter().map(|text| text.parse().expect("EFFORT")).collect();
    let joints = effort.len();

    let context = Context::with_options(ContextOptions::new().domain_id(domain)).unwrap();
    let mut node = context
        .new_node(NodeName::new("/", "ros2_client_arm").unwrap(), NodeOptions::new().enable_rosout(false))
        .unwrap();
    let states = publisher(&mut node, "operating_state", ("crtk_msgs", "OperatingState"), qos(100, Durability::TransientLocal));
    let measured = publisher(&mut node, "measured_js", TYPE, qos(100, Durability::Volatile));
    let malformed = publisher(&mut node, "malformed", TYPE, qos(100, Durability::TransientLocal));
    let efforts = subscription(&mut node, "servo_jf");
    let positions = subscription(&mut node, "servo_jp");

    let header = Header { sec: 1, nanosec: 2, frame_id: String::new() };
    states.publish(OperatingState { header, state: "ENABLED".to_string(), is_homed: true, is_busy: false }).unwrap();
    malformed.publish((1_u32, 2_u32, 0xffff_ffff_u32)).unwrap();
    println!("ready");

    let (mut effort_counts, mut position_counts) = (Counts::default(), Counts::default());
    let mut number = 0;
    let mut next = Instant::now();
    let mut last_command = Instant::now();
    while number < messages || last_command.elapsed() < Duration::from_secs(2) {
        let arrived = effort_counts.take(&efforts, |command| &command.effort, joints)
            | position_counts.take(&positions, |command| &command.position, joints);
        if arrived {
            last_command = Instant::now();
        }
        if number < messages && effort_counts.received + position_counts.received > 0 && Instant::now() >= next {
            number += 1;
            let state = JointState {
                header: Header { sec: (number / 1_000_000_000) as i32, nanosec: number, frame_id: String::new() },
                name: (0..joints).map(|k| format!("joint_{k}")).collect(),
                position: (0..joints).map(|k| 0.1 * k as f64).collect(),
                velocity: vec![0.0; joints],
                effort: effort.clone(),
            };
            measured.publish(state).unwrap();
            next = (next + Duration::from_millis(1)).max(Instant::now() - Duration::from_millis(100));
        }
        std::thread::sleep(Duration::from_micros(200));
    }
    effort_counts.print("servo_jf");
    position_counts.print("servo_jp");
}
