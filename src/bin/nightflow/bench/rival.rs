//! Rivals written in Python: one process that is asked for a step at a time.

use std::{
    cell::RefCell,
    io::{BufRead, BufReader, Write},
    path::{Path, PathBuf},
    process::{Child, ChildStdin, ChildStdout, Command, Stdio},
    rc::Rc,
};

use anyhow::{Context, Result, bail};
use nightflow::flow::manifest::Entry;
use serde_json::{Value, json};

use super::turns::{Turn, What};

/// It goes with the program, so that an installed one has it; what it is asked and answers stands at its head.
const SCRIPT: &str = include_str!("../../../../benches/rivals/step.py");

/// The bits that OpenVINO is asked for, and what they are called here.
pub const BITS: [(&str, &str); 2] = [("f32", "fp32"), ("bf16", "bf16")];

/// Methods of OpenCV's, what they are called here.
pub const METHODS: [(&str, &str); 2] = [("dis", "OpenCV DIS, medium"), ("farneback", "OpenCV Farnebäck")];

/// The process, as long as this lives.
pub struct Rival {
    child: Child,
    questions: ChildStdin,
    answers: BufReader<ChildStdout>,
    python: PathBuf,
}

impl Rival {
    fn start(python: &Path, [width, height]: [usize; 2], threads: usize) -> Result<Self> {
        let child = Command::new(python)
            .args(["-c", SCRIPT])
            .args([width, height, threads].map(|number| number.to_string()))
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn();
        let mut child = child.with_context(|| format!("{} does not start; name one by --python", python.display()))?;
        let (Some(questions), Some(answers)) = (child.stdin.take(), child.stdout.take()) else {
            bail!("{} has no standard input or output", python.display());
        };
        Ok(Self { child, questions, answers: BufReader::new(answers), python: python.into() })
    }

    /// Its number, by which the system knows it.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    fn ask(&mut self, question: &Value) -> Result<Value> {
        let ended = || format!("{} ended early", self.python.display());
        writeln!(self.questions, "{question}").with_context(ended)?;
        let mut line = String::new();
        if self.answers.read_line(&mut line).with_context(ended)? == 0 {
            bail!("{}", ended());
        }
        let answer: Value = serde_json::from_str(&line).with_context(|| format!("{} said {line:?}", ended()))?;
        match answer.get("error").and_then(Value::as_str) {
            Some(error) => bail!("{error}"),
            None => Ok(answer),
        }
    }

    /// The version of a package, or how to get it.
    fn need(&mut self, package: &str) -> Result<String> {
        let answer = self.ask(&json!({"need": package}))?;
        let word = |key: &str| answer.get(key).and_then(Value::as_str);
        match (word("version"), word("missing")) {
            (Some(version), _) => Ok(version.into()),
            (None, Some(missing)) => {
                let why = word("why").unwrap_or("it lacks it");
                bail!("{why}. To have it: {} -m pip install {missing}", self.python.display());
            }
            (None, None) => bail!("{} said {answer}", self.python.display()),
        }
    }
}

impl Drop for Rival {
    fn drop(&mut self) {
        // It may be in the midst of a step that nobody waits for; a failure here means that it has gone already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Who takes part, and why others don't.
#[derive(Default)]
pub struct Rivals {
    pub process: Option<Rc<RefCell<Rival>>>,
    pub turns: Vec<Turn>,
    /// Their libraries, with versions.
    pub about: Vec<String>,
    pub left_out: Vec<String>,
}

impl Rivals {
    /// OpenVINO with the same graphs, and OpenCV.
    pub fn open(
        python: &Path,
        size: [usize; 2],
        threads: usize,
        models: &Path,
        networks: &[(String, Entry)],
    ) -> Rivals {
        let mut rivals = Rivals::default();
        let process = match Rival::start(python, size, threads) {
            Ok(process) => Rc::new(RefCell::new(process)),
            Err(error) => {
                rivals.left_out.push(format!("all rivals: {error:#}"));
                return rivals;
            }
        };
        if rivals.has(&process, "openvino", "OpenVINO") {
            for (network, entry) in networks {
                for (bits, called) in BITS {
                    let files = [&entry.pyramid, &entry.decoder].map(|file| models.join(&file.file));
                    let open = json!({"kind": "openvino", "bits": bits, "pyramid": files[0], "decoder": files[1]});
                    rivals.enter(&process, What::OpenVino(network.clone(), called), open);
                }
            }
        }
        if rivals.has(&process, "cv2", "OpenCV") {
            for (kind, _) in METHODS {
                rivals.enter(&process, What::OpenCv(kind), json!({"kind": kind}));
            }
        }
        rivals.process = Some(process);
        rivals
    }

    fn has(&mut self, process: &Rc<RefCell<Rival>>, package: &str, called: &str) -> bool {
        match process.borrow_mut().need(package) {
            Ok(version) => {
                // OpenVINO's goes on with the commit.
                self.about.push(format!("{called} {}", version.split('-').next().unwrap_or(&version)));
                true
            }
            Err(error) => {
                self.left_out.push(format!("{called}: {error:#}"));
                false
            }
        }
    }

    fn enter(&mut self, process: &Rc<RefCell<Rival>>, what: What, mut open: Value) {
        let name = format!("{what:?}");
        open["open"] = name.clone().into();
        if let Err(error) = process.borrow_mut().ask(&open) {
            self.left_out.push(format!("{what}: {error:#}"));
            return;
        }
        let process = process.clone();
        let step = move || {
            let answer = process.borrow_mut().ask(&json!({"step": name}))?;
            answer.get("ms").and_then(Value::as_f64).with_context(|| format!("a rival said {answer}"))
        };
        self.turns.push(Turn { what, step: Box::new(step) });
    }
}
