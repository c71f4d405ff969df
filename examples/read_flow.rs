//! Reads the flow of a running node out of shared memory, without a copy.
//!
//! `cargo run --example read_flow -- [prefix] [steps]`; the node is started with `nightflow run`.

use std::time::Duration;

use iceoryx2::prelude::*;
use nightflow::publish::shared::{FlowHeader, VelocitySample};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut args = std::env::args().skip(1);
    let prefix = args.next().unwrap_or_else(|| "nightflow".into());
    let steps: u64 = args.next().map_or(Ok(u64::MAX), |steps| steps.parse())?;
    read(&prefix, steps)
}

/// Prints so many steps of the node with this prefix.
pub fn read(prefix: &str, steps: u64) -> Result<(), Box<dyn std::error::Error>> {
    let node = NodeBuilder::new().create::<ipc::Service>()?;
    let name: ServiceName = format!("{prefix}/flow").as_str().try_into()?;
    let flow = node.service_builder(&name).publish_subscribe::<[f32]>().user_header::<FlowHeader>().open()?;
    let flow = flow.subscriber_builder().create()?;
    let wake = node.service_builder(&name).event().open()?.listener_builder().create()?;
    let name: ServiceName = format!("{prefix}/velocity").as_str().try_into()?;
    let velocity = node.service_builder(&name).publish_subscribe::<VelocitySample>().open()?;
    let velocity = velocity.subscriber_builder().create()?;
    println!("reading");

    let mut seen = 0;
    // Woken by every step; the timeout only lets Ctrl-C through.
    while seen < steps && wake.timed_wait(|_| {}, Duration::from_secs(1)).is_ok() {
        while let Some(sample) = flow.receive()? {
            let header = sample.user_header();
            // (u right, v down) in camera pixels; the cell at (row, column) is vectors[row * width + column].
            let (vectors, _) = sample.payload().as_chunks::<2>();
            let middle = (header.height / 2 * header.width + header.width / 2) as usize;
            let [u, v] = vectors[middle];
            println!("step {}: {}×{}, {u:.3} {v:.3} px in the middle", header.step, header.width, header.height);
            seen += 1;
            // The node sends a step's flow last, so that its velocity is there by now.
            while let Some(sample) = velocity.receive()? {
                match sample.valid {
                    1 => println!("step {}: velocity {:?}", sample.step, sample.linear),
                    // Not standing still: nothing is known.
                    _ => println!("step {}: no velocity", sample.step),
                }
                if sample.step >= header.step {
                    break;
                }
            }
        }
    }
    Ok(())
}
