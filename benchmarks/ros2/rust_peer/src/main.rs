//! rust_peer echo   DOMAIN TOPIC        answer every JointState on TOPIC by the same on TOPIC_echo, until killed
//! rust_peer graph  DOMAIN              print the nodes that ros_discovery_info tells of, until killed
//! rust_peer params DOMAIN NODE NAME X  list the parameters of NODE, set NAME to the real number X, get it
use std::collections::BTreeSet;
use std::io::Write;
use std::time::{Duration, Instant};

use futures::StreamExt;
use mio::{Events, Poll, PollOpt, Ready, Token};
use ros2_client::parameters::raw;
use ros2_client::ros2::WriteError;
use ros2_client::rustdds::no_key::{DataReader, DataWriter};
use ros2_client::rustdds::{
    policy, DomainParticipant, Duration as DdsDuration, QosPolicies, QosPolicyBuilder, TopicKind,
};
use ros2_client::{
    Context, ContextOptions, Message, MessageTypeName, Name, NodeEvent, NodeName, NodeOptions,
};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

#[derive(Clone, Debug, Serialize, Deserialize)]
struct Time {
    sec: i32,
    nanosec: u32,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct Header {
    stamp: Time,
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
impl Message for JointState {}

// Services as rmw_cyclonedds has them: who asks, and the number of the question, stand in front.
#[derive(Debug, Serialize, Deserialize)]
struct Asked<T> {
    guid: u64,
    number: i64,
    content: T,
}

#[derive(Debug, Serialize, Deserialize)]
struct ListRequest {
    prefixes: Vec<String>,
    depth: u64,
}

#[derive(Debug, Serialize, Deserialize)]
struct ListReply {
    names: Vec<String>,
    prefixes: Vec<String>,
}

fn say(text: &str) {
    println!("{text}");
    std::io::stdout().flush().unwrap();
}

fn qos() -> QosPolicies {
    QosPolicyBuilder::new()
        .history(policy::History::KeepLast { depth: 10_000 })
        .reliability(policy::Reliability::Reliable { max_blocking_time: DdsDuration::from_millis(100) })
        .durability(policy::Durability::Volatile)
        .build()
}

fn context(domain: u16) -> Context {
    Context::with_options(ContextOptions::new().domain_id(domain)).unwrap()
}

fn echo(domain: u16, topic: &str) {
    let context = context(domain);
    let mut node = context.new_node(NodeName::new("/", "rust_peer").unwrap(), NodeOptions::new()).unwrap();
    let (space, base) = topic.rsplit_once('/').unwrap();
    let space = if space.is_empty() { "/" } else { space };
    let kind = MessageTypeName::new("sensor_msgs", "JointState");
    let echoed = format!("{base}_echo");
    let topic_in = node.create_topic(&Name::new(space, base).unwrap(), kind.clone(), &qos()).unwrap();
    let topic_out = node.create_topic(&Name::new(space, &echoed).unwrap(), kind, &qos()).unwrap();
    let reader = node.create_subscription::<JointState>(&topic_in, None).unwrap();
    let writer = node.create_publisher::<JointState>(&topic_out, None).unwrap();
    let poll = Poll::new().unwrap();
    poll.register(&reader, Token(1), Ready::readable(), PollOpt::edge()).unwrap();
    let mut events = Events::with_capacity(8);
    say("up");
    loop {
        poll.poll(&mut events, Some(Duration::from_millis(500))).unwrap();
        while let Ok(Some((mut message, _))) = reader.take() {
            // a full history is no loss: it empties when the other side has read
            while let Err(WriteError::WouldBlock { data }) = writer.publish(message) {
                message = data;
            }
        }
    }
}

fn graph(domain: u16) {
    let context = context(domain);
    let mut node = context.new_node(NodeName::new("/", "rust_peer").unwrap(), NodeOptions::new()).unwrap();
    smol::spawn(node.spinner().unwrap().spin()).detach();
    say("up");
    let mut known = BTreeSet::new();
    smol::block_on(node.status_receiver().for_each(|event| {
        if let NodeEvent::ROS(info) = event {
            for node in info.nodes() {
                let name = node.fully_qualified_name();
                if known.insert(name.clone()) {
                    say(&format!("node {name}"));
                }
            }
        }
        futures::future::ready(())
    }));
}

struct Service<Q: Serialize + std::fmt::Debug, A: DeserializeOwned + 'static> {
    writer: DataWriter<Asked<Q>>,
    reader: DataReader<Asked<A>>,
    number: i64,
}

impl<Q: Serialize + std::fmt::Debug, A: DeserializeOwned + 'static> Service<Q, A> {
    fn new(participant: &DomainParticipant, node: &str, service: &str, kind: &str) -> Self {
        let topic = |prefix: &str, end: &str, kind_end: &str| {
            let name = format!("{prefix}{node}/{service}{end}");
            let kind = format!("rcl_interfaces::srv::dds_::{kind}_{kind_end}_");
            participant.create_topic(name, kind, &qos(), TopicKind::NoKey).unwrap()
        };
        let asked = topic("rq", "Request", "Request");
        let answered = topic("rr", "Reply", "Response");
        let publisher = participant.create_publisher(&qos()).unwrap();
        let subscriber = participant.create_subscriber(&qos()).unwrap();
        Service {
            writer: publisher.create_datawriter_no_key_cdr(&asked, None).unwrap(),
            reader: subscriber.create_datareader_no_key_cdr(&answered, None).unwrap(),
            number: 0,
        }
    }

    /// Ask again and again: nobody is known at first.
    fn call(&mut self, make: impl Fn() -> Q) -> A {
        let begin = Instant::now();
        while begin.elapsed() < Duration::from_secs(60) {
            self.number += 1;
            let asked = Asked { guid: 0x1122_3344_5566_7788, number: self.number, content: make() };
            self.writer.write(asked, None).unwrap();
            let until = Instant::now() + Duration::from_millis(500);
            while Instant::now() < until {
                if let Ok(Some(sample)) = self.reader.take_next_sample() {
                    let answer = sample.into_value();
                    if answer.guid == 0x1122_3344_5566_7788 && answer.number == self.number {
                        return answer.content;
                    }
                }
                std::thread::sleep(Duration::from_millis(5));
            }
        }
        panic!("no answer within a minute");
    }
}

fn params(domain: u16, node: &str, name: &str, value: f64) {
    let participant = DomainParticipant::new(domain).unwrap();
    let mut list = Service::<ListRequest, ListReply>::new(&participant, node, "list_parameters", "ListParameters");
    let mut set = Service::<Vec<raw::Parameter>, Vec<raw::SetParametersResult>>::new(
        &participant,
        node,
        "set_parameters",
        "SetParameters",
    );
    let mut get = Service::<Vec<String>, Vec<raw::ParameterValue>>::new(
        &participant,
        node,
        "get_parameters",
        "GetParameters",
    );
    say("up");
    let found = list.call(|| ListRequest { prefixes: vec![], depth: 0 });
    say(&format!("names {}", found.names.join(" ")));
    let wanted = raw::Parameter::from(ros2_client::Parameter {
        name: name.to_string(),
        value: ros2_client::ParameterValue::Double(value),
    });
    let result = set.call(|| vec![wanted.clone()]);
    say(&format!("set {} {}", result[0].successful, result[0].reason));
    let got = get.call(|| vec![name.to_string()]);
    say(&format!("value {} {}", got[0].ptype, got[0].double_value));
}

fn main() {
    let arguments: Vec<String> = std::env::args().collect();
    let domain: u16 = arguments[2].parse().unwrap();
    match arguments[1].as_str() {
        "echo" => echo(domain, &arguments[3]),
        "graph" => graph(domain),
        "params" => params(domain, &arguments[3], &arguments[4], arguments[5].parse().unwrap()),
        other => panic!("{other}: expected echo, graph or params"),
    }
}
