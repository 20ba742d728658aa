"""A search by Optuna that goes on from its storage."""

import logging
import warnings
from typing import Any

from pnu.extras import needed


def search_arguments(hydra: Any) -> list[str]:
    """What the command line of a sweep gets added so that a search started again goes on.

    The trials still to do are those that the config wants less those that have ended; a trial that was interrupted
    comes again first, with its values, and so finds its run folder. The sampler's seed moves on, since the same seed
    would propose the same values again.

    Args:
        hydra: the group of that name of the composed config.
    """
    sweeper = hydra.sweeper
    storage = sweeper.get("storage")
    if "Optuna" not in str(sweeper.get("_target_")) or not storage:
        return []
    with needed("hydra/sweeper=optuna"):
        import optuna
        from optuna.trial import TrialState

    optuna.logging.set_verbosity(logging.WARNING)
    if sweeper.study_name not in {summary.study_name for summary in optuna.get_all_study_summaries(storage)}:
        return []
    study = optuna.load_study(study_name=sweeper.study_name, storage=storage)
    for trial in study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
        study.tell(trial.number, state=TrialState.FAIL)
        with warnings.catch_warnings(action="ignore"):  # "experimental" since 2020
            study.enqueue_trial(trial.params)
    ended = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE, TrialState.PRUNED))
    added = [f"hydra.sweeper.n_trials={max(0, sweeper.n_trials - len(ended))}"]
    if sweeper.sampler.get("seed") is not None:
        added.append(f"hydra.sweeper.sampler.seed={sweeper.sampler.seed + len(ended)}")
    return added
