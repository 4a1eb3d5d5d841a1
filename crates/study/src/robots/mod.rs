//! Studies of robot policies: which arms are trained on which demonstrations with how many seeds, what each training is
//! tested on, and which arms are compared. A study is a file; what came of it is one small file a training and test, and
//! a page that is made of those alone.

mod cells;
mod error;
mod file;
mod page;
mod result;
mod run;

pub use cells::{Cell, cells};
pub use error::StudyError;
pub use file::{Arm, CellRow, Comparison, Data, Study, Test};
pub use page::{robot_charts, robot_page};
pub use result::{CellResult, EpisodeOutcome};
pub use run::{RobotEvent, RobotStudyRequest, run_robot_study, stored_results};
