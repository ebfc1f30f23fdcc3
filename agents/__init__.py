"""Who decides: fixed schedules, rules, planners, learned policies; their training, evaluation and reports."""

DISTRIBUTION = "passive-env"
