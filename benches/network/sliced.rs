//! What the fused cost volume does, as a graph of ONNX's own operators: a slice, a product and a mean for each displacement.

use nightflow::flow::{Config, Error, Graph, cost_volume::Shape};

use super::onnx_bytes::{attribute, inner, model, node, number, value};

/// A list of whole numbers that nodes read.
fn constant(name: &str, values: [usize; 2]) -> Vec<u8> {
    node("Constant", &[], name, &[attribute("value_ints", &values.map(|value| value as u64))])
}

/// The graph of one level for ONNX Runtime on one thread, with the inputs older and newer [1, C, H, W], grid [1, H, W, 2] of
/// −1…1 and offsets [2, D, 1, 1], and the outputs volume and argmax. It leaves out the products with the gain and the sharpness.
pub fn graph(shape: Shape) -> Result<Graph, Error> {
    let Shape { height, width, reach, .. } = shape;
    let reach = reach as u64;
    let channels = inner(5, &[inner(1, b"axis"), number(3, 1), number(20, 2)].concat());
    let around = attribute("value_ints", &[0, 0, reach, reach, 0, 0, reach, reach]);
    let mut parts = vec![
        node("Constant", &[], "around", &[around]),
        constant("axes", [2, 3]),
        node("GridSample", &["newer", "grid"], "fetched", &[]),
        node("Pad", &["fetched", "around"], "padded", &[]),
    ];
    let mut means = vec![];
    for (dy, dx) in (0..shape.side()).flat_map(|dy| (0..shape.side()).map(move |dx| (dy, dx))) {
        let of = |what: &str| format!("{what}_{dy}_{dx}");
        let [start, end, slice, product, mean] = ["start", "end", "slice", "product", "mean"].map(of);
        parts.extend([
            constant(&start, [dy, dx]),
            constant(&end, [dy + height, dx + width]),
            node("Slice", &["padded", &start, &end, "axes"], &slice, &[]),
            node("Mul", &["older", &slice], &product, &[]),
            node("ReduceMean", &[&product], &mean, &[attribute("axes", &[1])]),
        ]);
        means.push(mean);
    }
    let means: Vec<&str> = means.iter().map(String::as_str).collect();
    let near = [attribute("kernel_shape", &[3, 3]), attribute("pads", &[1, 1, 1, 1])];
    parts.extend([
        node("Concat", &means, "volume", std::slice::from_ref(&channels)),
        node("AveragePool", &["volume"], "pooled", &near),
        node("Softmax", &["pooled"], "weights", &[channels]),
        node("Conv", &["weights", "offsets"], "argmax", &[]),
    ]);
    parts.extend(["older", "newer", "grid", "offsets"].map(|name| value(11, name)));
    parts.extend(["volume", "argmax"].map(|name| value(12, name)));
    let config = Config { threads: 1, ..Config::default() };
    Graph::of(&config, "the sliced cost volume".into(), &model(17, &parts), 4)
}

/// Where flow leads, as GridSample takes it.
pub fn grid(shape: &Shape, flow: &[f32]) -> Vec<f32> {
    let Shape { height, width, .. } = *shape;
    let place = |at: usize, flow: f32, cells: usize| (at as f32 + 0.5 + flow) * 2.0 / cells as f32 - 1.0;
    let (right, down) = flow.split_at(height * width);
    let both = right.iter().zip(down).enumerate();
    both.flat_map(|(at, (u, v))| [place(at % width, *u, width), place(at / width, *v, height)]).collect()
}
