"""Protection of records: AUTOSAR E2E profile 5 and SecOC."""
