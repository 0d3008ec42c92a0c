"""Stage `ingest`: photographs, tables and bags into one survey. Every decision about input is made here."""
