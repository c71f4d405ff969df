//! What the fused cost volume does, as a graph of ONNX's own operators: a slice, a product and a mean for each displacement.

use nightflow::flow::{Config, Error, Graph, cost_volume::Shape};

/// An attribute of a node; a list of whole numbers has another type than one.
enum Value<'a> {
    One(usize),
    List(&'a [usize]),
}
use Value::{List, One};

/// Appends a field of a message in protocol buffers, whose wire format ONNX files have.
fn field(to: &mut Vec<u8>, number: u8, bytes: &[u8]) {
    to.push(number << 3 | 2);
    varint(to, bytes.len() as u64);
    to.extend(bytes);
}

/// The same for a number.
fn number(to: &mut Vec<u8>, field: u8, value: usize) {
    varint(to, u64::from(field) << 3);
    varint(to, value as u64);
}

fn varint(to: &mut Vec<u8>, mut value: u64) {
    while value >= 0x80 {
        to.push(value as u8 | 0x80);
        value >>= 7;
    }
    to.push(value as u8);
}

/// Appends a node to a graph. Fields by their numbers in `onnx.proto`.
fn node(graph: &mut Vec<u8>, operator: &str, inputs: &[&str], output: &str, attributes: &[(&str, Value<'_>)]) {
    let mut node = vec![];
    inputs.iter().for_each(|input| field(&mut node, 1, input.as_bytes()));
    field(&mut node, 2, output.as_bytes());
    field(&mut node, 4, operator.as_bytes());
    for (name, value) in attributes {
        let mut attribute = vec![];
        field(&mut attribute, 1, name.as_bytes());
        match value {
            One(value) => number(&mut attribute, 3, *value),
            List(values) => values.iter().for_each(|value| number(&mut attribute, 8, *value)),
        }
        number(&mut attribute, 20, if matches!(value, One(_)) { 2 } else { 7 });
        field(&mut node, 5, &attribute);
    }
    field(graph, 1, &node);
}

/// A list of whole numbers that nodes read.
fn constant(graph: &mut Vec<u8>, name: &str, values: &[usize]) {
    node(graph, "Constant", &[], name, &[("value_ints", List(values))]);
}

/// A tensor of floats that goes in (field 11) or out (12).
fn outlet(graph: &mut Vec<u8>, direction: u8, name: &str, lengths: [usize; 4]) {
    let (mut shape, mut tensor, mut kind, mut outlet) = (vec![], vec![], vec![], vec![]);
    for length in lengths {
        let mut dimension = vec![];
        number(&mut dimension, 1, length);
        field(&mut shape, 1, &dimension);
    }
    number(&mut tensor, 1, 1);
    field(&mut tensor, 2, &shape);
    field(&mut kind, 1, &tensor);
    field(&mut outlet, 1, name.as_bytes());
    field(&mut outlet, 2, &kind);
    field(graph, direction, &outlet);
}

/// The graph of one level for ONNX Runtime on one thread, with the inputs older and newer [1, C, H, W], grid [1, H, W, 2] of
/// −1…1 and offsets [2, D, 1, 1], and the outputs volume and argmax. It leaves out the products
/// with the gain and the sharpness.
pub fn graph(shape: Shape) -> Result<Graph, Error> {
    let Shape { channels, height, width, reach } = shape;
    let displacements = shape.displacements();
    let mut graph = vec![];
    constant(&mut graph, "around", &[0, 0, reach, reach, 0, 0, reach, reach]);
    constant(&mut graph, "axes", &[2, 3]);
    node(&mut graph, "GridSample", &["newer", "grid"], "fetched", &[]);
    node(&mut graph, "Pad", &["fetched", "around"], "padded", &[]);
    let mut means = vec![];
    for (dy, dx) in (0..shape.side()).flat_map(|dy| (0..shape.side()).map(move |dx| (dy, dx))) {
        let of = |what: &str| format!("{what}_{dy}_{dx}");
        let [start, end, slice, product, mean] = ["start", "end", "slice", "product", "mean"].map(of);
        constant(&mut graph, &start, &[dy, dx]);
        constant(&mut graph, &end, &[dy + height, dx + width]);
        node(&mut graph, "Slice", &["padded", &start, &end, "axes"], &slice, &[]);
        node(&mut graph, "Mul", &["older", &slice], &product, &[]);
        node(&mut graph, "ReduceMean", &[&product], &mean, &[("axes", List(&[1]))]);
        means.push(mean);
    }
    let names: Vec<&str> = means.iter().map(String::as_str).collect();
    node(&mut graph, "Concat", &names, "volume", &[("axis", One(1))]);
    let near = [("kernel_shape", List(&[3, 3])), ("pads", List(&[1, 1, 1, 1]))];
    node(&mut graph, "AveragePool", &["volume"], "pooled", &near);
    node(&mut graph, "Softmax", &["pooled"], "weights", &[("axis", One(1))]);
    node(&mut graph, "Conv", &["weights", "offsets"], "argmax", &[]);
    field(&mut graph, 2, b"sliced");
    for name in ["older", "newer"] {
        outlet(&mut graph, 11, name, [1, channels, height, width]);
    }
    outlet(&mut graph, 11, "grid", [1, height, width, 2]);
    outlet(&mut graph, 11, "offsets", [2, displacements, 1, 1]);
    outlet(&mut graph, 12, "volume", [1, displacements, height, width]);
    outlet(&mut graph, 12, "argmax", [1, 2, height, width]);
    let (mut opset, mut model) = (vec![], vec![]);
    field(&mut opset, 1, b"");
    number(&mut opset, 2, 17);
    number(&mut model, 1, 8);
    field(&mut model, 7, &graph);
    field(&mut model, 8, &opset);
    let config = Config { threads: 1, ..Config::default() };
    Graph::of(&config, "the sliced cost volume".into(), &model, 4)
}

/// Where flow leads, as GridSample takes it.
pub fn grid(shape: &Shape, flow: &[f32]) -> Vec<f32> {
    let Shape { height, width, .. } = *shape;
    let place = |at: usize, flow: f32, cells: usize| (at as f32 + 0.5 + flow) * 2.0 / cells as f32 - 1.0;
    let (right, down) = flow.split_at(height * width);
    let both = right.iter().zip(down).enumerate();
    both.flat_map(|(at, (u, v))| [place(at % width, *u, width), place(at / width, *v, height)]).collect()
}
