//! The tables of a bench, in Markdown, and what its pictures show.

use std::fmt::Write as _;

use nightflow::flow::{Operators, manifest::Entry};

use super::{
    errors::Errors,
    ours::{Product, padded},
    rival::{BITS, METHODS},
    turns::{Found, LEAD, Times, What},
};

/// What the fused operators are to reach against plain ones.
const AIM_FUSED: f64 = 0.65;
/// What the step in bf16 is to reach against plain operators.
const AIM_BF16: f64 = 0.25;
/// What our step is to reach against OpenVINO's in 32 bits.
const AIM_OPENVINO: f64 = 0.8;
/// What convolutions are to take of what a product of matrices would, in 32 bits and in bf16.
const AIMS_LIMIT: [f64; 2] = [1.0, 0.35];
/// The area that a network's multiply-adds are noted for.
const NOTED_AREA: f64 = 320.0 * 256.0;

/// How the rivals did.
pub struct Beside {
    pub about: Vec<String>,
    pub left_out: Vec<String>,
    /// Memory of their process, MiB.
    pub resident: Option<f64>,
}

/// Everything that was found.
#[derive(Default)]
pub struct Report {
    pub about: Vec<String>,
    pub provider: String,
    pub networks: Vec<(String, Entry)>,
    pub followed: String,
    pub size: [usize; 2],
    pub threads: usize,
    pub rounds: usize,
    pub steps: Found,
    pub rivals: Option<Beside>,
    pub growth: Found,
    /// The sizes and threads of `growth`, in their order.
    pub sizes: Vec<([usize; 2], usize)>,
    /// Milliseconds of each of ours' convolutions by themselves.
    pub alone: Vec<(What, f64)>,
    /// By how much the process grew with each of ours, MiB.
    pub memory: Vec<(What, Option<f64>)>,
    /// Memory before any network was opened, MiB.
    pub base: Option<f64>,
    /// Memory after the steps with all networks open, MiB.
    pub whole: Option<f64>,
}

/// Whose step it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Whose {
    Ours,
    OpenVino,
    OpenCv,
}

/// What a picture shows of somebody.
pub struct Point {
    pub whose: Whose,
    /// The network or the method.
    pub name: String,
    pub ms: f64,
    /// End-point error by day and in the dark, px.
    pub epe: [Option<f64>; 2],
}

fn number(value: Option<f64>, decimals: usize) -> String {
    value.filter(|value| value.is_finite()).map_or("–".into(), |value| format!("{value:.decimals$}"))
}

/// `72.1 (68.0)`: the median and the best.
fn ms(times: Option<&Times>) -> String {
    times.map_or("–".into(), |times| format!("{:.1} ({:.1})", times.median(), times.best()))
}

fn ratio(of: Option<&Times>, to: Option<&Times>) -> String {
    number(of.zip(to).map(|(of, to)| of.over(to)), 2)
}

fn size([width, height]: [usize; 2]) -> String {
    format!("{width}×{height}")
}

fn heading(text: &mut String, title: &str, columns: &[&str]) {
    let _ = writeln!(text, "\n## {title}\n\n| {} |\n|{}", columns.join(" | "), " --- |".repeat(columns.len()));
}

impl Report {
    /// The tables.
    pub fn markdown(&self) -> String {
        let mut text = String::from("# nightflow bench\n\n");
        for line in self.about.iter().chain([&self.provider]) {
            let _ = writeln!(text, "- {line}");
        }
        let beside = self.rivals.iter().flat_map(|beside| &beside.about);
        beside.for_each(|line| _ = writeln!(text, "- {line}"));
        let _ = writeln!(
            text,
            "- images of {}, threads: {}, rounds: {}\n\nWhat a section compares ran in turns, of a turn's {} steps the last was timed, as in a \
             stream. Milliseconds are medians, in brackets the best; ratios are medians of the ratios within a round.",
            size(self.size),
            self.threads,
            self.rounds,
            LEAD + 1
        );
        self.step(&mut text);
        if let Some(beside) = &self.rivals {
            self.beside(&mut text, beside);
        }
        self.grown(&mut text);
        self.limit(&mut text);
        self.resident(&mut text);
        text
    }

    fn of(&self, network: &str, operators: Operators) -> Option<&Times> {
        self.steps.of(&What::Step(network.into(), operators))
    }

    /// With the operators that the node takes.
    fn ours(&self, network: &str) -> Option<&Times> {
        self.of(network, Operators::Fused).or_else(|| self.of(network, Operators::Plain))
    }

    fn tiles(&self, network: &str) -> Option<&Times> {
        self.steps.of(&What::Tiles(network.into()))
    }

    fn step(&self, text: &mut String) {
        let aim = format!("fused / plain (aim {AIM_FUSED})");
        let fast = format!("bf16 / plain (aim {AIM_BF16})");
        heading(text, "The network's step", &["network", "fused, ms", "plain, ms", &aim, "bf16, ms", &fast]);
        for (network, _) in &self.networks {
            let (fused, plain) = (self.of(network, Operators::Fused), self.of(network, Operators::Plain));
            let tiles = self.tiles(network);
            let ratios = [ratio(fused, plain), ratio(tiles, plain)];
            let [fused, plain, tiles] = [fused, plain, tiles].map(ms);
            let _ = writeln!(text, "| {network} | {fused} | {plain} | {} | {tiles} | {} |", ratios[0], ratios[1]);
        }
        let added = self.steps.of(&What::Refined(self.followed.clone())).zip(self.ours(&self.followed));
        let added = number(added.map(|(refined, ours)| refined.less(ours)), 2);
        let _ = writeln!(text, "\nRefining adds {added} ms to the step of {}.", self.followed);
    }

    fn beside(&self, text: &mut String, Beside { left_out, resident, .. }: &Beside) {
        let aim = format!("ours / it (aim {AIM_OPENVINO})");
        let columns = [
            "network",
            "ours, ms",
            "OpenVINO fp32, ms",
            &aim,
            "ours in bf16, ms",
            "OpenVINO bf16, ms",
            "ours in bf16 / it",
        ];
        heading(text, "The same weights in OpenVINO", &columns);
        for (network, _) in &self.networks {
            let _ = write!(text, "| {network} |");
            for ((_, bits), ours) in BITS.into_iter().zip([self.ours(network), self.tiles(network)]) {
                let rival = self.steps.of(&What::OpenVino(network.clone(), bits));
                let _ = write!(text, " {} | {} | {} |", ms(ours), ms(rival), ratio(ours, rival));
            }
            text.push('\n');
        }
        let over = format!("{} / it", self.followed);
        heading(text, "Methods without a network, on 8-bit grey", &["method", "ms", &over]);
        for (kind, called) in METHODS {
            let times = self.steps.of(&What::OpenCv(kind));
            let _ = writeln!(text, "| {called} | {} | {} |", ms(times), ratio(self.ours(&self.followed), times));
        }
        if resident.is_some() {
            let _ = writeln!(text, "\nThe rivals' process holds {} MiB.", number(*resident, 0));
        }
        if !left_out.is_empty() {
            let _ = writeln!(text, "\nLeft out:\n");
            left_out.iter().for_each(|line| _ = writeln!(text, "- {line}"));
        }
    }

    fn grown(&self, text: &mut String) {
        let over = format!("over {}", size(self.size));
        let title = format!("How the cost of {} grows", self.followed);
        heading(text, &title, &["image", "threads", "ms", "ms per megapixel", &over, "memory, MiB"]);
        let followed = self.networks.iter().find(|(name, _)| *name == self.followed);
        for &(sides, threads) in &self.sizes {
            let what = What::Sized(sides, threads);
            let (times, base) = (self.growth.of(&what), self.growth.of(&What::Sized(self.size, threads)));
            let inside = followed.map_or(sides, |(_, entry)| padded(sides, entry));
            let note = if inside == sides { String::new() } else { format!(", continued to {}", size(inside)) };
            let megapixels = (sides[0] * sides[1]) as f64 * 1e-6;
            let _ = writeln!(
                text,
                "| {}{note} | {threads} | {} | {} | {} | {} |",
                size(sides),
                ms(times),
                number(times.map(|times| times.median() / megapixels), 0),
                ratio(times, base),
                number(self.grew(&what), 0)
            );
        }
    }

    fn limit(&self, text: &mut String) {
        let aims = format!("over the product's (aims {}, bf16 {})", AIMS_LIMIT[0], AIMS_LIMIT[1]);
        let columns =
            ["network", "GFLOP of convolutions", "GFLOP/s of the step", "of the product's", "convolutions, ms", &aims];
        heading(text, "How near the processor's limit", &columns);
        let product = self.steps.of(&What::Product);
        // 10⁹ operations in a millisecond are 10³ of them in a second.
        let rate = |gigamacs: f64, times: &Times| 2e3 * gigamacs / times.median();
        for (network, entry) in &self.networks {
            let [width, height] = padded(self.size, entry);
            let gigamacs = entry.gigamacs.map(|noted| noted * (width * height) as f64 / NOTED_AREA);
            for (bits, ours) in [("", self.ours(network)), (", bf16", self.tiles(network))] {
                if ours.is_none() && !bits.is_empty() {
                    continue;
                }
                let known = gigamacs.zip(ours);
                let part = known.zip(product).map(|((g, times), product)| g / Product::GIGAMACS * product.over(times));
                let alone = self.alone.iter().find(|(what, _)| match what {
                    What::Step(name, _) => bits.is_empty() && name == network,
                    What::Tiles(name) => !bits.is_empty() && name == network,
                    _ => false,
                });
                let alone = alone.map(|(_, ms)| *ms);
                let least = gigamacs.zip(product).map(|(g, product)| g / Product::GIGAMACS * product.median());
                let _ = writeln!(
                    text,
                    "| {network}{bits} | {} | {} | {} | {} | {} |",
                    number(gigamacs.map(|gigamacs| 2.0 * gigamacs), 2),
                    number(known.map(|(gigamacs, times)| rate(gigamacs, times)), 0),
                    number(part, 2),
                    number(alone, 1),
                    number(alone.zip(least).map(|(alone, least)| alone / least), 2)
                );
            }
        }
        let reached = number(product.map(|times| rate(Product::GIGAMACS, times)), 0);
        let _ = writeln!(
            text,
            "\nA product of matrices of 32-bit floats in the same library, in the same turns: {reached} GFLOP/s. Convolutions by \
             themselves are the runtime's own record of one more run of each network, medians of its nodes; in bf16 they \
             hold the encoder's normalisations too."
        );
    }

    fn grew(&self, what: &What) -> Option<f64> {
        self.memory.iter().find(|(known, _)| known == what).and_then(|(_, grown)| *grown)
    }

    fn resident(&self, text: &mut String) {
        heading(text, "Memory that a network takes", &["network", "fused, MiB", "plain, MiB"]);
        for (network, _) in &self.networks {
            let grew = |operators| number(self.grew(&What::Step(network.clone(), operators)), 0);
            let _ = writeln!(text, "| {network} | {} | {} |", grew(Operators::Fused), grew(Operators::Plain));
        }
        let _ = writeln!(
            text,
            "\nResident before any was opened: {} MiB, with the runtime's library and four frames; after the steps, with all of \
             them open: {} MiB.",
            number(self.base, 0),
            number(self.whole, 0)
        );
    }

    /// Everybody's milliseconds.
    pub fn milliseconds(&self) -> Vec<Point> {
        let networks = || self.networks.iter().map(|(name, _)| name.clone());
        let ours = networks().map(|name| (Whose::Ours, self.ours(&name), name));
        let openvino =
            networks().map(|name| (Whose::OpenVino, self.steps.of(&What::OpenVino(name.clone(), BITS[0].1)), name));
        let methods = METHODS
            .iter()
            .map(|(kind, called)| (Whose::OpenCv, self.steps.of(&What::OpenCv(kind)), (*called).to_owned()));
        let point = |(whose, times, name): (Whose, Option<&Times>, String)| {
            times.map(|times| Point { whose, name, ms: times.median(), epe: [None, None] })
        };
        ours.chain(openvino).chain(methods).filter_map(point).collect()
    }

    /// The same with end-point errors, and who has none. In OpenVINO a network has the same.
    pub fn points(&self, errors: &Errors) -> (Vec<Point>, Vec<String>) {
        let (mut points, mut unknown) = (vec![], vec![]);
        for point in self.milliseconds() {
            let method =
                METHODS.iter().find(|(_, called)| *called == point.name).map_or(&*point.name, |(kind, _)| kind);
            let epe = errors.of(method);
            if epe != [None, None] {
                points.push(Point { epe, ..point });
            } else if !unknown.iter().any(|known| known == method) {
                unknown.push(method.to_owned());
            }
        }
        (points, unknown)
    }
}
