"""The service: flights one after the other, each engaged by the pilot. See README.md."""
