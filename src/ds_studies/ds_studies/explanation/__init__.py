"""Why a test fails on one simulator and not on another, by experiment."""
