//! zenoh_peer echo    DOMAIN TOPIC        answer every JointState on TOPIC by the same on TOPIC_echo, until killed
//! zenoh_peer robot   DOMAIN TOPIC        publish best effort at 100 Hz, as many drivers do, until killed
//! zenoh_peer giant   DOMAIN TOPIC        publish 20 times a second: a good message, one with a name of 1 MB, one of
//!                                        100 000 numbers, one whose length field lies; until killed
//! zenoh_peer latched DOMAIN TOPIC        publish three messages that are kept, and read such on TOPIC_too; until killed
//! zenoh_peer graph   DOMAIN              print the nodes that the graph tells of, until killed
//! zenoh_peer params  DOMAIN NODE NAME X  list the parameters of NODE, set NAME to the real number X, get it
//!
//! ZENOH_CONFIG_OVERRIDE says how peers find each other, as for rmw_zenoh_cpp.
use std::collections::BTreeSet;
use std::io::Write;
use std::num::NonZeroUsize;
use std::sync::Arc;
use std::time::Duration;

use hiroz::prelude::*;
use hiroz::Builder;
use hiroz_msgs::builtin_interfaces::Time;
use hiroz_msgs::sensor_msgs::JointState;
use hiroz_msgs::std_msgs::Header;

fn say(text: &str) {
    println!("{text}");
    std::io::stdout().flush().unwrap();
}

fn qos(reliable: bool, latched: bool) -> QosProfile {
    QosProfile {
        reliability: if reliable { QosReliability::Reliable } else { QosReliability::BestEffort },
        durability: if latched { QosDurability::TransientLocal } else { QosDurability::Volatile },
        history: QosHistory::KeepLast(NonZeroUsize::new(if latched { 1 } else { 10_000 }).unwrap()),
        ..Default::default()
    }
}

fn state(k: u32, names: Vec<String>) -> JointState {
    let count = names.len();
    let position: Vec<f64> = (0..count).rev().map(|i| 0.1 * (i + 1) as f64).collect();
    let effort: Vec<f64> = (0..count).rev().map(|i| (i + 1) as f64).collect();
    let stamp = Time { sec: (100 + k / 100) as i32, nanosec: k % 100 * 10_000_000 };
    let header = Header { stamp, frame_id: String::new() };
    JointState { header, name: names, position, velocity: vec![], effort }
}

/// A1 to A7, from the last to the first.
fn joints() -> Vec<String> {
    (1..=7).rev().map(|k| format!("A{k}")).collect()
}

async fn echo(node: ZNode, topic: &str) -> Result<()> {
    let reader = node.create_sub::<JointState>(topic).with_qos(qos(true, false)).build()?;
    let writer = node.create_pub::<JointState>(&format!("{topic}_echo")).with_qos(qos(true, false)).build()?;
    say("up");
    loop {
        writer.async_publish(&reader.async_recv().await?).await?;
    }
}

async fn robot(node: ZNode, topic: &str) -> Result<()> {
    let writer = node.create_pub::<JointState>(topic).with_qos(qos(false, false)).build()?;
    say("up");
    for k in 0.. {
        writer.publish(&state(k, joints()))?;
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    Ok(())
}

async fn giant(node: ZNode, topic: &str) -> Result<()> {
    let writer = node.create_pub::<JointState>(topic).with_qos(qos(true, false)).build()?;
    say("up");
    // a head, a stamp, an empty frame, and as many names as a number can say
    let mut lie = vec![0, 1, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0];
    lie.extend([0xff; 4]);
    lie.extend([0; 64]);
    for k in 0.. {
        writer.publish(&state(k, joints()))?;
        let mut long = joints();
        long[0] = "x".repeat(1_000_000);
        writer.publish(&state(k, long))?;
        let mut many = state(k, joints());
        many.position = vec![0.0; 100_000];
        writer.publish(&many)?;
        writer.publish_serialized(lie.clone())?;
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
    Ok(())
}

async fn latched(node: ZNode, topic: &str) -> Result<()> {
    let writer = node.create_pub::<JointState>(topic).with_qos(qos(true, true)).build()?;
    for k in 1..=3 {
        writer.publish(&state(k, joints()))?;
    }
    let reader = node.create_sub::<JointState>(&format!("{topic}_too")).with_qos(qos(true, true)).build()?;
    say("up");
    loop {
        let message = reader.async_recv().await?;
        say(&format!("kept {}", message.header.stamp.sec));
    }
}

async fn graph(node: ZNode) -> Result<()> {
    say("up");
    let mut known = BTreeSet::new();
    loop {
        for (name, space) in node.graph().get_node_names() {
            let full = format!("{}/{name}", space.trim_end_matches('/'));
            if known.insert(full.clone()) {
                say(&format!("node {full}"));
            }
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}

async fn params(node: ZNode, of: &str, name: &str, value: f64) -> Result<()> {
    let target = ParameterTarget::from_fqn(of).expect("the full name of a node");
    let client = ParameterClient::new(Arc::new(node), target)?;
    say("up");
    let none: [&str; 0] = [];
    let found = loop {
        // nobody is known at first
        if let Ok(found) = client.list(&none, None).await {
            break found;
        }
        tokio::time::sleep(Duration::from_millis(100)).await;
    };
    say(&format!("names {}", found.names.join(" ")));
    let result = client.set(&[Parameter::new(name, ParameterValue::Double(value))]).await?;
    say(&format!("set {} {}", result[0].successful, result[0].reason));
    let wrong = client.set_atomically(&[Parameter::new(name, ParameterValue::Bool(true))]).await?;
    say(&format!("set {} {}", wrong.successful, wrong.reason));
    say(&format!("value {:?}", client.get(&[name]).await?[0]));
    say(&format!("type {:?}", client.get_types(&[name]).await?[0]));
    say(&format!("meaning {}", client.describe(&[name]).await?[0].description));
    Ok(())
}

#[tokio::main]
async fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().collect();
    let domain: usize = arguments[2].parse().unwrap();
    let context = ZContextBuilder::default().with_domain_id(domain).build()?;
    let node = context.create_node("zenoh_peer").build()?;
    match arguments[1].as_str() {
        "echo" => echo(node, &arguments[3]).await,
        "robot" => robot(node, &arguments[3]).await,
        "giant" => giant(node, &arguments[3]).await,
        "latched" => latched(node, &arguments[3]).await,
        "graph" => graph(node).await,
        "params" => params(node, &arguments[3], &arguments[4], arguments[5].parse().unwrap()).await,
        other => panic!("{other}: expected echo, robot, giant, latched, graph or params"),
    }
}
