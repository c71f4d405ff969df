//! `nightflow eval reference`: reference flow for pairs without a truth, laid out so that `nightflow eval` judges by it.

use std::{
    fs,
    path::{Path, PathBuf},
};

use anyhow::{Context, Result, bail};
use nightflow::{
    darkness::{
        datasets::{self, Found, Item, KINDS, Kind, Loaded, Skipped},
        flow_files::{self, Field},
        ladder::Linear,
        methods::{self, Method, Shown},
        picture::Picture,
        reference::{self, Row},
    },
    flow,
};

use crate::{Exit, launch};

/// Where what is for eyes goes: beside the frames a picture of the flow could pass for the flow itself.
const PICTURES: &str = "pictures";

/// Reference flow for bright pairs, checked there and back: what VBOF's authors did with FlowNet2, for anybody's camera.
#[derive(clap::Args)]
#[command(after_help = "\
Examples:
  nightflow eval reference mine/ --out judged              (CCPPQQEE_img1.*: linear, as VBOF's)
  nightflow eval judged --models pwcnet_fcdn,zero          (each exposure by its scene's reference)
  nightflow eval reference photos/ --linear --out judged   (NAME_img1.jpg, _img2.jpg: sRGB)
  nightflow eval ladder judged --models pwcnet_fcdn,zero   (the same, photographed ever darker)
  nightflow eval reference mine/ --model big=flownet2.onnx --out judged

CCPPQQEE is camera, position before, position after and exposure, two digits each, 01 the brightest. \
Exposures of one scene, taken from the very same two places, share the reference of the brightest whose \
files are whole.

A vector is kept where the flow back from its end leads to its beginning (Sundaram et al. 2010) inside \
the frame; elsewhere NAME_flow.flo says unknown (1e10), and nobody is judged there. A pair of which less \
than a tenth is kept has no reference. Don't judge the network that made it, nor a relative: they err alike.

--out gets the frames (linked, copied where that can't be done), NAME_flow.flo, pictures/NAME_mask.png \
(white: known), pictures/NAME_colours.png and reference.md. Where pairs have a NAME_flow.flo, the reference \
is compared with it.

Raws are reduced to 736 columns, as VBOF's. Pictures are taken as they are, and RAFT's memory grows with the \
square of their area: 0.6 GB at 640x480, 4.3 GB at 1280x720.

A missing or torn file is named and left out, and the program ends with 3.")]
pub struct Args {
    /// The pairs: CCPPQQEE_img1.* and CCPPQQEE_img2.* (VBOF), or NAME_img1.* and NAME_img2.*.
    pairs: PathBuf,
    /// The folder to write: a new or an empty one.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// What finds the flow: a network of the manifest, NAME=FOLDER/NETWORK, NAME=FILE.onnx of two images (0…255; @1
    /// behind it: 0…1), NAME=FOLDER of another program's none/CONDITION/PAIR_flow.flo and PAIR_back_flow.flo, where
    /// CONDITION is all or, of VBOF, as exposure_1.
    #[arg(long, default_value = "raftsmall_fcdn_12")]
    model: String,
    /// The files are sRGB pictures: undo the curve and bring the mean to 0.4, as the node sees the world.
    #[arg(long)]
    linear: bool,
    /// The layout, where it can't be told from the folder: vbof, pairs.
    #[arg(long, value_parser = super::kind)]
    layout: Option<Kind>,
    /// Only pairs whose name contains this.
    #[arg(long, value_name = "TEXT")]
    only: Option<String>,
    /// Threads of the networks.
    #[arg(long, default_value_t = 2)]
    threads: usize,
    /// A launch file whose [flow] says with what networks are computed: runtime, provider, precision, operators, models.
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
}

/// Makes the references and prints their table.
pub fn run(args: &Args) -> Result<Exit> {
    let Found { kind, mut items, mut skipped } = datasets::find_unlabelled(&args.pairs, args.layout)?;
    if let Some(text) = &args.only {
        items.retain(|item| item.name.contains(text));
        skipped.retain(|left| left.what.contains(text));
    }
    if items.is_empty() && skipped.is_empty() {
        let named = args.only.as_ref().map_or(String::new(), |text| format!(" named {text}"));
        bail!("{} has no pair{named}", args.pairs.display());
    }
    let config = flow::Config { threads: args.threads, ..launch::read(args.config.as_deref())?.flow };
    let mut method = Method::open(&args.model, &config)?;
    prepare(&args.out)?;
    let layout = KINDS.iter().find(|(_, known)| *known == kind).map_or("", |(name, _)| name);
    let scenes = reference::scenes(kind, items);
    let light = if args.linear { "sRGB, the curve undone and the mean brought to 0.4" } else { "as it is" };
    let judge = if args.linear { " --linear" } else { "" };
    let about = [
        ("data".to_owned(), format!("{} ({layout}), light {light}", args.pairs.display())),
        (format!("flow by {}", method.name), method.about()),
        (
            "known where".to_owned(),
            "|F + B|² ≤ 0.01 (|F|² + |B|²) + 0.5 inside the frame (Sundaram et al. 2010)".into(),
        ),
        ("judge by it".to_owned(), format!("nightflow eval {}{judge} --models pwcnet_fcdn,zero", args.out.display())),
        ("not to be judged".to_owned(), format!("{} and its relatives, which err as the reference does", method.name)),
    ];
    let bar = super::progress(scenes.len())?;
    let mut rows = vec![];
    for scene in &scenes {
        bar.set_message(scene[0].name.clone());
        rows.extend(make(scene, &mut method, args, &mut skipped)?);
        bar.inc(1);
    }
    bar.finish_and_clear();
    let table = reference::markdown(&about, &rows, &skipped);
    print!("{table}");
    let path = args.out.join("reference.md");
    fs::write(&path, table).with_context(|| path.display().to_string())?;
    Ok(if skipped.is_empty() { Exit::Done } else { Exit::DataLost })
}

/// Makes the folder, and refuses one with files in it: a reference must not replace a truth, nor lie beside an older one
/// that readers could take for it.
fn prepare(out: &Path) -> Result<()> {
    fs::create_dir_all(out).with_context(|| out.display().to_string())?;
    let mut inside = fs::read_dir(out).with_context(|| out.display().to_string())?;
    if let Some(Ok(found)) = inside.next() {
        let found = found.file_name();
        bail!("--out {}: expected a new or an empty folder, found {}", out.display(), found.to_string_lossy());
    }
    let pictures = out.join(PICTURES);
    fs::create_dir_all(&pictures).with_context(|| pictures.display().to_string())
}

/// The reference of a scene: of its brightest pair that can be read. What can't be used is added to `skipped`.
fn make(scene: &[Item], method: &mut Method, args: &Args, skipped: &mut Vec<Skipped>) -> Result<Option<Row>> {
    for (at, item) in scene.iter().enumerate() {
        let Loaded { mut frames, truths } = match datasets::load(item) {
            Ok(loaded) => loaded,
            Err(left) => {
                skipped.push(left);
                continue;
            }
        };
        if args.linear {
            frames = Linear::of([&frames[0], &frames[1]]).scaled();
        }
        let both = match both_ways(item, &frames, method) {
            Ok(both) => both,
            // Others' results may be torn; a network that fails is no matter of one pair.
            Err(methods::Error::File(error)) => {
                skipped.push(Skipped { what: item.name.clone(), why: datasets::said(&error) });
                continue;
            }
            Err(error) => return Err(error).context(item.name.clone()),
        };
        let [forward, backward] = &both;
        let sizes = [(frames[0].width, frames[0].height), (forward.width, forward.height)];
        let checked = reference::check(forward, backward).filter(|_| sizes[0] == sizes[1]);
        let Some(checked) = checked else {
            let [(width, height), (wide, high)] = sizes;
            let (back, high_back) = (backward.width, backward.height);
            let why = format!("expected flow of {width}×{height}, found {wide}×{high} there, {back}×{high_back} back");
            skipped.push(Skipped { what: item.name.clone(), why });
            continue;
        };
        if checked.valid < reference::VALID_MIN {
            let [found, least] = [checked.valid, reference::VALID_MIN].map(|part| 100.0 * part);
            let why = format!("expected {least} % of its vectors to come back to where they began, found {found:.1} %");
            skipped.push(Skipped { what: item.name.clone(), why });
            continue;
        }
        write(&args.out, item, &checked.field)?;
        for frame in scene[at..].iter().flat_map(|item| &item.frames) {
            place(frame, &args.out)?;
        }
        let against = truths.first().and_then(|(_, truth)| reference::against(&checked.field, forward, truth));
        let (valid, length, apart) = (checked.valid, checked.length, checked.apart);
        return Ok(Some(Row { pair: item.name.clone(), exposures: scene.len() - at, valid, length, apart, against }));
    }
    Ok(None)
}

/// The flow there and the flow back.
fn both_ways(item: &Item, frames: &[Picture; 2], method: &mut Method) -> Result<[Field; 2], methods::Error> {
    let folder = Path::new("none").join(item.condition.replace([' ', '/'], "_"));
    let [older, newer] = frames;
    let mut find = |frames: [&Picture; 2], role: &str| {
        let place = folder.join(format!("{}_{role}.flo", item.name));
        method.flow(&Shown { frames, place: &place })
    };
    Ok([find([older, newer], "flow")?, find([newer, older], "back_flow")?])
}

fn write(out: &Path, item: &Item, field: &Field) -> Result<()> {
    let picture = |what: &str| out.join(PICTURES).join(format!("{}_{what}.png", item.name));
    flow_files::write(&out.join(format!("{}_flow.flo", item.name)), field)?;
    flow_files::write_mask(&picture("mask"), field)?;
    flow_files::write_picture(&picture("colours"), field, field.longest())?;
    Ok(())
}

/// A frame under its own name in the folder: the same file where links can be made, else a copy.
fn place(frame: &Path, out: &Path) -> Result<()> {
    let Some(name) = frame.file_name() else { return Ok(()) };
    // What a symbolic link leads to, for a link to the link itself would lead elsewhere.
    let from = fs::canonicalize(frame).with_context(|| frame.display().to_string())?;
    let to = out.join(name);
    if fs::hard_link(&from, &to).is_err() {
        fs::copy(&from, &to).with_context(|| format!("{} to {}", frame.display(), to.display()))?;
    }
    Ok(())
}
