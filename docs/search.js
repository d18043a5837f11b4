/*
 * The search of Sphinx finds pages that have every word typed, and a heading only if it contains the text as typed.
 * People type a symptom in their own words. So headings and index entries that share most of its words come first.
 */
var Scorer = {
  // The values of Sphinx; pages for contributors and the list of changes come last.
  objNameMatch: 11,
  objPartialMatch: 6,
  objPrio: { 0: 15, 1: 5, 2: -5 },
  objPrioDefault: 0,
  title: 15,
  partialTitle: 7,
  term: 5,
  partialTerm: 2,
  score: ([page, , , , score]) => (/^(contributing\/|changelog)/.test(page) ? score - 30 : score),
};

(() => {
  const LEAST_SHARE = 0.5; // of the weight of the words typed
  const HIGHEST = 100; // beside 15 for a page with a word in its title

  const stemmer = new Stemmer();
  const wordsOf = (text) =>
    new Set(
      splitQuery(text.toLowerCase().replace(/(\d),(?=\d{3})/g, "$1"))
        .filter((word) => !stopwords.has(word))
        .map((word) => stemmer.stemWord(word)),
    );

  const common = (some, others) => [...some].filter((word) => others.has(word));

  // Main index entries are other words for one heading of their page: the one with most of these words.
  let headings;
  const readHeadings = ({ alltitles, indexentries, docnames, filenames, titles }) => {
    const found = [];
    for (const [text, places] of Object.entries(alltitles)) {
      for (const [file, id] of places) {
        const title = titles[file] === text ? text : `${titles[file]} > ${text}`;
        const result = [docnames[file], title, id ? `#${id}` : "", null, 0, filenames[file], SearchResultKind.title];
        found.push({ file, texts: [wordsOf(text)], words: wordsOf(text), result });
      }
    }
    const entries = new Map();
    for (const [text, places] of Object.entries(indexentries)) {
      for (const [file, id, main] of places) {
        if (!main) continue;
        if (!entries.has(`${file} ${id}`)) entries.set(`${file} ${id}`, { file, texts: [] });
        entries.get(`${file} ${id}`).texts.push(wordsOf(text));
      }
    }
    const own = found.map(({ file, words }) => ({ file, words: new Set(words) }));
    for (const { file, texts } of entries.values()) {
      const all = new Set(texts.flatMap((words) => [...words]));
      const shares = own.map((one) => (one.file === file ? common(one.words, all).length / one.words.size : -1));
      const heading = found[shares.indexOf(Math.max(...shares))];
      heading.texts.push(...texts);
      for (const word of all) heading.words.add(word);
    }
    return found;
  };

  const matches = (query) => {
    headings ??= readHeadings(Search._index);
    const rarity = new Map();
    for (const word of wordsOf(query)) {
      const count = headings.filter(({ words }) => words.has(word)).length;
      if (count) rarity.set(word, Math.log(1 + headings.length / count));
    }
    const weigh = (words) => words.reduce((sum, word) => sum + rarity.get(word), 0);
    const all = weigh([...rarity.keys()]);
    return headings.flatMap(({ texts, words, result }) => {
      const share = all && weigh(common(rarity.keys(), words)) / all;
      if (share < LEAST_SHARE) return [];
      // Of two headings with the same words, the one with fewer others is nearer.
      const nearest = Math.max(...texts.map((one) => common(one, rarity).length / one.size));
      const score = Math.round(HIGHEST * share * (0.7 + 0.3 * nearest));
      return [result.with(4, score)];
    });
  };

  const searchPages = Search._performSearch;
  Search._performSearch = (query, ...rest) => {
    const pages = searchPages(query, ...rest).filter(([, , id]) => !id.startsWith("#index-")); // headings have their words
    const found = [...pages, ...matches(query).map((one) => one.with(4, Scorer.score(one)))];
    // Of several hits at one place the best stays; the last one is shown first.
    const best = new Map();
    for (const one of found.sort((a, b) => a[4] - b[4])) {
      const place = one[5] + one[2];
      best.delete(place);
      best.set(place, one);
    }
    return [...best.values()];
  };
})();
