"""Public names of the package; `__init__.py` imports each on its first use."""

from calibration.campaign.campaign import Campaign as Campaign
from calibration.campaign.campaign import FitSettings as FitSettings
from calibration.campaign.campaign import Noise as Noise
from calibration.campaign.campaign import Test as Test
from calibration.campaign.campaign import load_campaign as load_campaign
from calibration.campaign.measured import MeasuredCurve as MeasuredCurve
from calibration.campaign.measured import read_measured as read_measured
from calibration.diagnosis.diagnosis import Diagnosis as Diagnosis
from calibration.diagnosis.result import DiagnosisResult as DiagnosisResult
from calibration.diagnosis.result import diagnosis_to_json as diagnosis_to_json
from calibration.fit.fit import Fit as Fit
from calibration.fit.fit import Minimum as Minimum
from calibration.fit.fit import Nuisance as Nuisance
from calibration.fit.fit import Prediction as Prediction
from calibration.fit.hold import HoldFit as HoldFit
from calibration.fit.hold import fit_hold as fit_hold
from calibration.fit.result import CalibrationResult as CalibrationResult
from calibration.fit.result import to_json as to_json
from calibration.importing.files import import_files as import_files
from calibration.importing.imported import Imported as Imported
from calibration.importing.imported import Wishes as Wishes
from calibration.pipeline import calibrate as calibrate
from calibration.pipeline import diagnose as diagnose
from calibration.tasks.errors import WorkerError as WorkerError
from calibration.tasks.executors import Workers as Workers
from tissue_sim.recording.formats.guesses import Stated as Stated
